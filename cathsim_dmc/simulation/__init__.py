"""Many simulations of one task, stepped together."""
