"""Navigation tasks and their meaning as pure functions of arrays."""
