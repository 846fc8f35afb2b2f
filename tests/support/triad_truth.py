"""What the simulated gyroscopes of three axes are made with, coefficient by coefficient."""

from bayescal_models.gyro_triad.simulator import BASELINE

TRUE = {
    f"{name}[{part}]": value
    for name, parts in (
        ("bias.constant", "xyz"),
        ("scale.constant", "xyz"),
        ("misalignment.constant", ("xy", "xz", "yz", "yx", "zx", "zy")),
    )
    for part, value in zip(parts, BASELINE[name], strict=True)
}
