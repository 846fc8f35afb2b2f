"""The plan of poses of an accelerometer triad: that of any three axes."""

from bayescal_models.triad.campaign import Campaign as Campaign
