"""Contact of devices with fields, through the collision table of MuJoCo."""
