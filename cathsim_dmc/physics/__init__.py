"""What is simulated, and what acts on it in every control and physics step."""
