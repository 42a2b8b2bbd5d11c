import sys

from sb3_hds.cli import main

sys.exit(main())
