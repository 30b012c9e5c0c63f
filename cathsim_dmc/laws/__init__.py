"""Laws of the physics: pure functions of parameters, time and state."""
