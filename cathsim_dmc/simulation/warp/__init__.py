"""Simulations on MuJoCo Warp: thousands of worlds on one GPU, or a few on the CPU."""
