"""Fluoroscopy on the CPU: pure functions of arrays, no OpenGL."""
