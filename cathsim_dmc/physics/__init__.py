"""Simulated quantities, and the effects of every control and physics step."""
