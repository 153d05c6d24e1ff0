"""`python -m stickslip`: the command, where its script is not on the path."""

import sys

from stickslip.workflows.commands import main

if __name__ == "__main__":
    sys.exit(main())
