"""The noise of a sensor at rest as a command: N, B, K with intervals, a picture, the numbers that a filter needs."""

from __future__ import annotations

from pathlib import Path

import bayescal as bc
from bayescal._cli import options
from bayescal._cli.console import print_notes, print_result, result_folder
from bayescal._cli.options import ColumnOptions, Commands, ModelOptions, ReadRequest
from bayescal._core.errors import InputError

commands = Commands()
AT_REST = (
    "still_sensor"  # the instrument whose output does not change but by its noise and temperature
)


@commands.example(
    "bayescal noise still.csv --columns output=gyro_x --unit gyro_x=deg/s --yaml imu.yaml"
)
def noise(
    files: list[Path],
    columns: ColumnOptions,
    channels: str | None = None,
    yaml: Path | None = None,
    quantile: float = 0.95,
    topic: str = "/imu0",
    average: str | None = None,
    seed: int = 0,
    out: Path | None = None,
    json_: bool = False,
) -> None:
    """Noise density, bias instability and random walk of a sensor at rest, with 95 % intervals."""
    from bayescal._cli.request import open_channels, open_request
    from bayescal._use.kalibr_file import kalibr_yaml

    if not 0 < quantile < 1:
        raise InputError(
            f"--quantile {quantile:g}: give a probability between 0 and 1, such as 0.95"
        )
    asked = ReadRequest(AT_REST, files, columns, ModelOptions(), average)
    if channels is None:
        _, _, one = open_request(asked)
        name = next((s.output for s in one.sources if s.output), "output")
        readings = {name: one}
    else:
        _, _, readings = open_channels(options.channel_names(channels), asked)
    with result_folder(out) as folder:
        found = {}
        for name, one in readings.items():
            print_notes(one.flags)
            found[name] = bc.noise(one, seed=seed)
            if not json_:
                print(f"{name}\n\n{found[name]}\n")
        if json_:
            print_result({name: one.data() for name, one in found.items()})
        written = []
        if yaml is not None:
            yaml.write_text(kalibr_yaml(found, topic, quantile), encoding="utf-8")
            written.append(yaml)
        for name, one in found.items() if folder is not None else ():
            assert folder is not None
            written.append(bc.plot.save(bc.plot.noise(one), folder / f"noise_{name}.png"))
        if written and not json_:
            print(f"written: {', '.join(map(str, written))}")
