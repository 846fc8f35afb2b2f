"""Settings of other libraries that the current folder may hold: a folder of readings decides nothing.

Two libraries look there when they are loaded, before anywhere else, and no variable or argument has them not to.
"""

from __future__ import annotations

import os
from contextlib import suppress
from importlib import import_module

READERS = {"matplotlibrc": "matplotlib", "arvizrc": "arviz_base"}  # file → what obeys it


def obey_no_folder() -> None:
    """Load what would obey a file of the current folder while another folder is the current one.

    To be called before other threads are begun: a process has one current folder. Costs nothing where there is no such
    file.
    """
    readers = [library for file, library in READERS.items() if os.path.lexists(file)]
    if readers:
        here = os.getcwd()
        os.chdir(os.path.dirname(__file__))
        try:
            for library in readers:
                with suppress(ImportError):  # what needs it says so
                    import_module(library)
        finally:
            os.chdir(here)
