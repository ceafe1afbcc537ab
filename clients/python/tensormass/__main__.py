"""`python -m tensormass` is the command `tensormass`."""

import sys

from tensormass_tools.cli import main

sys.exit(main())
