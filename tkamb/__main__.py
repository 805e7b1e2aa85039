"""`tkamb` on the command line, and `python -m tkamb`."""

import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Ctrl-C during the import of tkamb prints one line, not a traceback.
    """
    try:
        from tkamb.cli import main as command

        return command(arguments)
    except KeyboardInterrupt:
        print("tkamb: interrupted: nothing is kept", file=sys.stderr)
        return 130


if __name__ == "__main__":
    raise SystemExit(main())
