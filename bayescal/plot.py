"""Pictures, as functions that return Matplotlib figures: `bc.plot.residuals(calibration)`, ….

Colours that the colour-blind can tell apart (Okabe and Ito), a unit on every axis.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub("bayescal", __file__)
