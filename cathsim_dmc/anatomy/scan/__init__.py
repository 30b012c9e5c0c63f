"""Import of a patient's lumen surface."""
