"""`python -m jaxsky`: the command line."""

from fits.app import main

main()
