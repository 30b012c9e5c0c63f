"""`python -m cathsim_dmc.cli`, where the command is not on the path."""

from cathsim_dmc.cli import main

main()
