"""Two-axis quartz inclinometer: zero offset against placement angle, and its on-line compensation."""

from bayescal_models.inclinometer.campaign import VERIFICATION as VERIFICATION
from bayescal_models.inclinometer.campaign import Accelerometer as Accelerometer
from bayescal_models.inclinometer.campaign import Campaign as Campaign
from bayescal_models.inclinometer.compensation import Compensated as Compensated
from bayescal_models.inclinometer.compensation import compensate as compensate
from bayescal_models.inclinometer.compensation import zero_of as zero_of
from bayescal_models.inclinometer.files import accelerometers as accelerometers
from bayescal_models.inclinometer.files import negated as negated
from bayescal_models.inclinometer.files import read as read
from bayescal_models.inclinometer.model import INSTRUMENT as INSTRUMENT
from bayescal_models.inclinometer.model import simulate as simulate
from bayescal_models.inclinometer.verification import Verification as Verification
from bayescal_models.inclinometer.verification import read_verification as read_verification
