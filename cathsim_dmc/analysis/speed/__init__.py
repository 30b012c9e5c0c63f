"""How fast the simulator is, and where the time goes: `cathsim benchmark speed`."""
