"""``python -m prbayes``: see `prbayes.cli`."""

import sys

from prbayes.cli import main

if __name__ == "__main__":
    sys.exit(main())
