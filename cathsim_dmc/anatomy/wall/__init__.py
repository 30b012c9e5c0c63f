"""The wall of a lumen: convex pieces, measured depth, fidelity."""
