"""`python -m jaxtri.cli`."""

from jaxtri.cli import main

if __name__ == "__main__":
    main()
