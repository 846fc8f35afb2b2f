"""`python -m bayescal`: the command line."""

import os
import sys

if sys.path[:1] == [os.getcwd()]:  # `-m` puts it there, but files in the current folder are data
    del sys.path[0]

from bayescal._cli.main import main

if __name__ == "__main__":
    main()
