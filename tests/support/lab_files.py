"""One gyroscope test, and ways to write it down: what the tests of a laboratory's files share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, NamedTuple

import numpy as np

TIME = np.arange(12) * 10.0
TEMPERATURE = 20 + 0.125 * TIME
RATE = 0.5 + 0.015625 * (TEMPERATURE - 25)  # °/s, in binary fractions
BEGAN = datetime(2026, 11, 22, 23, 59, 0, 123000, tzinfo=UTC)
HEAD = ("time [s]", "temperature [degC]", "output [deg/s]")


def text(
    head: Sequence[str] = HEAD,
    columns: Sequence[Any] = (TIME, TEMPERATURE, RATE),
    separator: str = ",",
    decimal: str = ".",
) -> str:
    """A text file of these columns."""

    def cell(value: Any) -> str:
        return value if isinstance(value, str) else repr(float(value)).replace(".", decimal)

    rows = [separator.join(map(cell, row)) for row in zip(*columns, strict=True)]
    return "\n".join([separator.join(head), *rows, ""])


def when(form: Callable[[datetime], str], zone: str = "") -> list[str]:
    return [form(BEGAN + timedelta(seconds=t)) + zone for t in TIME]


def dated(form: Callable[[datetime], str], head: str = "Timestamp", zone: str = "") -> str:
    return text((head, *HEAD[1:]), (when(form, zone), TEMPERATURE, RATE))


def counted(per_second: int, head: str) -> str:
    began = round(BEGAN.timestamp() * 1e3) * per_second // 1000
    counts = [str(began + int(t) * per_second) for t in TIME]
    return text((head, *HEAD[1:]), (counts, TEMPERATURE, RATE))


def with_cell(row: int, column: int, cell: str, source: str = "") -> str:
    lines = [line.split(",") for line in (source or text()).splitlines()]
    lines[row - 1][column] = cell
    return "\n".join([",".join(line) for line in lines] + [""])


def iso(moment: datetime) -> str:
    return moment.replace(tzinfo=None).isoformat(timespec="milliseconds")


def spaced(moment: datetime) -> str:
    return iso(moment).replace("T", " ")


def is_right(readings, left_out=()):
    kept = np.setdiff1d(np.arange(len(TIME)), left_out)
    np.testing.assert_array_equal(readings["time"], TIME[kept])
    np.testing.assert_allclose(readings["temperature"], TEMPERATURE[kept], rtol=1e-14)
    np.testing.assert_allclose(readings["output"], RATE[kept], rtol=1e-14)


# --- files as instruments and programs export them, from their public formats ---------------------


class Export(NamedTuple):
    """A file as a laboratory exports it, of the same test.

    Attributes:
        name: of the file.
        content: of it.
        cure: options that the one refusal names, NUMBER and UNIT as a person completes them; empty where it is read.
    """

    name: str
    content: str | bytes
    cure: str = ""


def _rows(*columns: Sequence[str], separator: str = ",", end: str = "") -> str:
    return "".join(separator.join(row) + end + "\n" for row in zip(*columns, strict=True))


def _numbers(values: Any, decimal: str = ".") -> list[str]:
    return [repr(float(v)).replace(".", decimal) for v in values]


def _labview(decimal: str) -> str:
    """LabVIEW's measurement file (.lvm), version 2: a head, channels, tabs, a column of comments that is empty."""
    head = (
        "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\n"
        f"Decimal_Separator\t{decimal}\nMulti_Headings\tNo\nX_Columns\tOne\nTime_Pref\tRelative\nOperator\tlab\n"
        "Date\t2026/11/22\nTime\t23:59:00.1230000\n***End_of_Header***\t\n\t\n"
        "Channels\t2\t\t\nSamples\t12\t12\t\nDate\t2026/11/22\t2026/11/22\t\n"
        "Time\t23:59:00.123\t23:59:00.123\t\nY_Unit_Label\tdegC\tdeg/s\t\nX_Dimension\tTime\tTime\t\n"
        "X0\t0.0000000000000000E+0\t0.0000000000000000E+0\t\nDelta_X\t10.000000\t10.000000\t\n"
        "***End_of_Header***\t\t\t\nX_Value\tTemperature\tRate\tComment\n"
    )
    return head + _rows(*(_numbers(v, decimal) for v in (TIME, TEMPERATURE, RATE)), separator="\t")


def _dated(form: str, milli: str = "") -> list[str]:
    """Moments in a form; `milli` stands between seconds and milliseconds."""
    return when(
        lambda m: m.strftime(form) + (f"{milli}{m.microsecond // 1000:03}" if milli else "")
    )


def lab_exports() -> dict[str, Export]:
    """Twenty files of one test of a gyroscope."""
    temperature, rate, seconds = _numbers(TEMPERATURE), _numbers(RATE), _numbers(TIME)
    comma_t, comma_r = _numbers(TEMPERATURE, ","), _numbers(RATE, ",")
    counted = [str(i + 1) for i in range(len(TIME))]
    us, benchlink = _dated("%m/%d/%Y %H:%M:%S", "."), _dated("%m/%d/%Y %H:%M:%S", ":")
    early = when(lambda m: f"{m - timedelta(days=20):%m/%d/%Y %I:%M:%S %p}")
    day, clock = _dated("%d.%m.%Y"), _dated("%H:%M:%S", ",")
    return {
        "LabVIEW (.lvm)": Export("test.lvm", _labview("."), "--columns 'output=Rate [deg/s]'"),
        "LabVIEW (.lvm), decimal commas": Export("test.lvm", _labview(","), "--columns 'output=Rate [deg/s]'"),
        "LabVIEW, US dates between tabs": Export(
            "us.txt",
            "Time\tTemperature (deg C)\tOutput (deg/s)\n" + _rows(us, temperature, rate, separator="\t"),
        ),
        "LabVIEW, US dates that leave the day open": Export(
            "us.csv",
            "Date/Time,Temp (degF),Output (deg/s)\n" + _rows(early, _numbers(1.8 * TEMPERATURE + 32), rate),
            "--date-order mdy",
        ),
        "LabVIEW, European": Export(
            "eu.txt",
            "Zeit\tTemperatur (°C)\tOutput (°/s)\n"
            + _rows(_dated("%d/%m/%Y-%H:%M:%S", "."), comma_t, comma_r, separator="\t"),
        ),
        "Keysight BenchLink Data Logger": Export(
            "scan.csv",
            "Name:,Gyro 7\nOwner:,lab\nComments:,\nAcquisition Date:,11/22/2026 11:59:00 PM\n\n"
            "Instrument:,34970A,Address:,GPIB0::9::INSTR\nTotal Channels:,2\nChannel,Name,Function\n"
            "101,oven,Temp (Type K)\n102,gyro,DC Voltage\n\nScan Control:,\nStart Action:,Immediately\n\n"
            "Scan,Time,101 <oven> (C),102 <gyro> (VDC)\n"
            + _rows(counted, benchlink, temperature, _numbers(1.25 + 2e-3 * RATE)),
            "--columns 'output=102 <gyro> (VDC)' --columns 'temperature=101 <oven> (C)' "
            "--nominal-scale '0.002 VDC/(deg/s)' --nominal-zero '1.25 V'",
        ),
        "Keysight BenchVue DMM": Export(
            "dmm.csv",
            "Instrument,34465A\nSerial Number,MY00000001\nSample Interval,10 s\nStart Time,11/22/2026 23:59:00.123\n\n"
            "Date and Time,Temperature (°C),Rate (dps)\n" + _rows(us, temperature, rate),
            "--columns 'output=Rate (dps)'",
        ),
        "NI TDMS as CSV": Export(
            "tdms.csv",
            "Group,Untitled,,\nAuthor,lab,,\nStart,11/22/2026 11:59:00 PM,,\n,,,\n"
            "Time (s),Temp_deg,Gyro_dps,\n" + _rows(seconds, temperature, rate, end=","),
            "--columns output=Gyro_dps",
        ),
        "NI SignalExpress": Export(
            "log.txt",
            "Time - Temperature\tAmplitude - Temperature (Deg C)\tAmplitude - Rate (deg/s)\n"
            + _rows(us, temperature, rate, separator="\t"),
            "--columns 'temperature=Amplitude - Temperature (Deg C)' "
            "--columns 'output=Amplitude - Rate (deg/s)'",
        ),
        "Fluke Hydra": Export(
            "fluke.csv",
            "Date,Time,CH1 (DegC),CH2 (VDC)\n"
            + _rows(_dated("%m/%d/%y"), _dated("%H:%M:%S", "."), temperature, _numbers(2e-3 * RATE)),
            "--columns 'output=CH2 (VDC)' --columns 'temperature=CH1 (DegC)' --nominal-scale '0.002 VDC/(deg/s)'",
        ),
        "FlukeView": Export(
            "fluke289.csv",
            "Fluke 289,V1.16\nSerial,95000001\n\nReading,Start Time,Temperature,Output\n,,°C,deg/s\n"
            + _rows(counted, _dated("%m/%d/%Y %H:%M:%S", "."), temperature, rate),
        ),
        "a German logger": Export(
            "logger.csv",
            ("Messung 7\nDatum;Uhrzeit;Temperatur [°C];Ausgang [°/s];\n"
             + _rows(day, clock, comma_t, comma_r, separator=";", end=";")).encode("cp1252"),
            "--columns 'output=Ausgang [°/s]'",
        ),
        "Excel, two header rows as CSV": Export(
            "two.csv",
            "Elapsed Time,Temperature,Output\n(s),(°C),(°/s)\n" + _rows(seconds, temperature, rate),
        ),
        "Excel, German": Export(
            "mappe.csv",
            "Zeit [s];Temperatur [°C];Drehrate [°/s]\n"
            + _rows(_numbers(TIME, ","), comma_t, comma_r, separator=";"),
            "--columns 'output=Drehrate [°/s]'",
        ),
        "Campbell TOA5": Export(
            "station.dat",
            '"TOA5","lab","CR1000","1","CR1000.Std.32","CPU:gyro.CR1","1234","Table1"\n'
            '"TIMESTAMP","RECORD","Temp_C","Output"\n"TS","RN","Deg C","deg/s"\n"","","Avg","Smp"\n'
            + _rows([f'"{spaced_}"' for spaced_ in when(spaced)], counted, temperature, rate),
            "--columns 'temperature=Temp_C [Deg C]'",
        ),
        "Tektronix, a preamble beside numbers": Export(
            "TEK00001.csv",
            "Model,DPO2024\nFirmware Version,1.52\nHorizontal Units,s\nSample Interval,10.0\nRecord Length,12\n\n"
            "TIME,T,CH1\n(s),(degC),(V)\n" + _rows(seconds, temperature, _numbers(2e-3 * RATE)),
            "--columns 'output=CH1 [V]' --nominal-scale '0.002 V/(deg/s)'",
        ),
        "Agilent VEE, the year first": Export(
            "vee.txt",
            "Time stamp;Temp.(°C);Output [mdps]\n"
            + _rows(_dated("%Y/%m/%d %H:%M:%S", "."), temperature, _numbers(1e3 * RATE), separator=";"),
        ),
        "MATLAB writetable": Export(
            "table.csv",
            "Time,Temp_degC,Output_deg_s\n" + _rows(_dated("%d-%b-%Y %H:%M:%S", "."), temperature, rate),
        ),
        "pandas": Export(
            "frame.csv",
            ",timestamp,temp_C,gyro_z_dps\n"
            + _rows([str(i) for i in range(len(TIME))], when(spaced), temperature, rate),
            "--columns output=gyro_z_dps",
        ),
        "an Arduino": Export(
            "arduino.txt",
            "millis,temp,rate\n" + _rows([f"{1e3 * t:.0f}" for t in TIME], temperature, rate),
            "--columns output=rate --unit millis=ms --unit temp=degC --unit rate=dps",
        ),
    }  # fmt: skip
