"""Episodes: recorded, kept, written as Rerun files, looked at."""
