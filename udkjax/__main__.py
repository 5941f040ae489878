"""`python -m udkjax`: the command line."""

from udkjax.cli import main

if __name__ == "__main__":
    main()
