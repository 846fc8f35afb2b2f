"""Public logs of others at rest: where each is from, and how its file is made."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StillLog:
    """A log, and where it is from.

    Attributes:
        title, file: of the page, and the file in the folder.
        source, commit, path, licence: the repository, its commit, the path there, and what it allows.
        made: how the file is made of what stands there.
        channels: its columns.
    """

    title: str
    file: str
    source: str
    commit: str
    path: str
    licence: str
    made: str
    channels: tuple[str, ...]


def _ocxo(title: str, file: str, which: str) -> StillLog:
    return StillLog(
        title=title,
        file=file,
        source="https://github.com/aewallin/allantools",
        commit="599dc9ea133ea4852f97e5ed88e51dc11bbdae1f",
        path="tests/ocxo/ocxo_frequency.txt",
        licence="LGPL 3",
        made=f"{which}: times of 1 Hz before the departures of the frequency from 10 MHz, in parts of 10¹², and the "
        "header `time [s],frequency [1]`",
        channels=("frequency",),
    )


LOGS = (
    StillLog(
        title="ADIS16405, three gyroscopes and three accelerometers",
        file="adis_16405_imu1.csv",
        source="https://github.com/SMAC-Group/imudata",
        commit="eec6e5b627a31a4a1c286e0d1475c6556705b2a6",
        path="data/adis_16405_imu1.rda",
        licence="CC BY-NC-SA 4.0; recorded at the University of Calgary, Department of Geomatics Engineering",
        made="Times of 100 Hz before its six columns, and the header "
        "`time [s],gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s],acc_x [g],acc_y [g],acc_z [g]`",
        channels=("gyro_x", "gyro_y", "gyro_z", "acc_x", "acc_y", "acc_z"),
    ),
    _ocxo(
        "Oven-controlled crystal oscillator against a hydrogen maser",
        "ocxo_whole.csv",
        "All readings",
    ),
    _ocxo(
        "The same oscillator after its events",
        "ocxo_calm.csv",
        "From 7700 s on: of what is before, `bayescal noise` says that there are events",
    ),
)
