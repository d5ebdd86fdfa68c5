"""``python -m selfcorrect``."""

import sys

from selfcorrect.cli import main

sys.exit(main())
