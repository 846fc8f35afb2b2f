"""Functions that plot results and return Matplotlib figures: `bc.plot.residuals(calibration)`, ….

The palette is distinguishable with colour vision deficiency (Okabe and Ito); every axis has a unit.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub("bayescal", __file__)
