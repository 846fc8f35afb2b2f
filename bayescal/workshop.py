"""Interface for extensions of bayescal: annexes, and other packages with commands and files of their own.

The public names of `bayescal` are for calibration. This module exports the functions and classes of which bayescal's
own results, commands and files are built: text, tables, units, JSON, folders, options, reports. They are listed in
`workshop.pyi`, load on first use, and may change in any version.
"""

import lazy_loader

from bayescal._core import (
    deadline as deadline,  # modules: the stub of `lazy_loader` can re-export names only
)
from bayescal._report import plot_colours as plot_colours

__getattr__, __dir__, __all__ = lazy_loader.attach_stub("bayescal", __file__)
