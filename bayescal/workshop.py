"""Interface for extensions of bayescal: annexes, and other packages with commands and files of their own.

The public names of `bayescal` are for calibrating. Here are the parts of its own results, commands and files: text,
tables, units, JSON, folders, options, reports. The names are listed in `workshop.pyi`, and each loads on first use.
They may change with a version.
"""

import lazy_loader

from bayescal._core import (
    deadline as deadline,  # modules: the stub of `lazy_loader` can re-export names only
)
from bayescal._report import plot_colours as plot_colours

__getattr__, __dir__, __all__ = lazy_loader.attach_stub("bayescal", __file__)
