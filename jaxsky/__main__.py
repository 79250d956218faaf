"""`python -m jaxsky`: the command line."""

from fits.app import main

if __name__ == "__main__":  # not in the processes that it starts
    main()
