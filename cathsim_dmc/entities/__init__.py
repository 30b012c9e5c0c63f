"""MuJoCo entities: arena, phantom, catheter, introducer sheath, robot."""
