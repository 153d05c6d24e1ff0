"""`python -m stickslip`: the command, where its script is not on the path."""

import sys


def main() -> int:
    """Run the command; it ends in silence if it is interrupted while it loads."""
    try:
        from stickslip.workflows.commands import main as command

        return command()
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
