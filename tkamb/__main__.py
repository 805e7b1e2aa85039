"""`python -m tkamb` is `tkamb`, where no command is on the path."""

from tkamb.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
