"""``python -m tapping_cell VERB``."""

import sys

from tapping_cell.cli import main

if __name__ == "__main__":
    sys.exit(main())
