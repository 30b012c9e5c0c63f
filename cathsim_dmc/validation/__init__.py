"""Validation of the physics against closed forms; each `validate_…` in its module."""
