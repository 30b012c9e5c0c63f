"""The physics steps of a control step."""

PHYSICS_TIMESTEP = 0.004  # s
CONTROL_TIMESTEP = 0.04  # s, one frame of fluoroscopy
