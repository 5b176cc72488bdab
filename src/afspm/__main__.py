"""`python -m afspm` is `afspm`."""

from afspm.cli import main

if __name__ == "__main__":
    main()
