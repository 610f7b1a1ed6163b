"""``python -m recon`` is ``lissajous``."""

import sys

from recon.cli import main

sys.exit(main())
