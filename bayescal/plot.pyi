"""Pictures, each listed once. `lazy_loader` reads this file when `bayescal.plot` is imported."""

from ._report.plots import allan as allan
from ._report.plots import loop as loop
from ._report.plots import missing as missing
from ._report.plots import noise as noise
from ._report.plots import residuals as residuals
from ._report.plots import save as save
from ._report.plots import trail as trail

__all__: list[str]
