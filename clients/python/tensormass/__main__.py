"""`python -m tensormass` is the command `tensormass`."""

import sys

from tensormass.cli import main

sys.exit(main())
