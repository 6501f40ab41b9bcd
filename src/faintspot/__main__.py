"""Run the command line with python -m faintspot."""

from faintspot.cli import main

main()
