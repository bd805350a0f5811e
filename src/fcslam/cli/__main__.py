"""`python -m fcslam.cli`."""

import sys

from fcslam.cli import main

sys.exit(main())
