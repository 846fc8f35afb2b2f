"""A second face, for those who build on bayescal: annexes, and other packages with commands and files of their own.

What `bayescal` itself offers is for those who calibrate. Here is what its own results, commands and files are made of:
text, tables, units, JSON, folders, options, reports. The names stand in `workshop.pyi`, and each loads on first use.
They may change with a version.
"""

import lazy_loader

from bayescal._core import (
    deadline as deadline,  # modules, which `lazy_loader` hands on from one place only
)
from bayescal._report import plot_colours as plot_colours

__getattr__, __dir__, __all__ = lazy_loader.attach_stub("bayescal", __file__)
