"""A file dropped on the page: what `calibrate` would say of it, and one form for how it is to be read."""

from __future__ import annotations

import re
import shutil
import tempfile
import weakref
from io import BytesIO
from pathlib import Path
from typing import Any

import panel as pn
import panel.models.file_dropper  # its scripts come with the page

from bayescal._core.errors import InputError
from bayescal._data.measurements import Measurements
from bayescal._data.read import read
from bayescal._data.read_options import MISSING_READINGS, expected_columns
from bayescal._data.unit_parsing import STANDARD_GRAVITY
from bayescal._tables.dates import ORDERS
from bayescal._tables.mapping_file import save_mapping
from bayescal._tables.open_table import TEXT, open_table
from bayescal._tables.raw_table import bytes_text
from bayescal._workbench.panes.pane import Pane
from bayescal._workbench.parts.pieces import button, column, download, field, halves, row, words
from bayescal._workbench.parts.style import INSIDE

MOST = 200_000_000  # bytes of one file; larger ones are given on the command line
OFFERED = 300  # columns of a file that a list offers; others are typed
TOLD = 6000  # letters of what is wrong
AS_FOUND = "as found"
INSTEAD = (  # of an option
    (r"--columns '?([^='\s]+)=([^'\n]+?)'?(?=\s*\n|\s{2}|$)", r"left: \1 is \2"),
    (r"--unit '?([^='\n]+)=([^'\n]+?)'?(?=\s*\n|\s{2}|$)", r"left: \1 in \2"),
    (r"--(\w+)-(\w+)\b", r"left: \1 \2"),
    (r"--(missing|decimal)\b", r"left: \1"),
)


class Upload(pn.widgets.FileDropper):
    """Panel's own, which trusts the browser with the size: here more than MOST is not kept on this side either."""

    def _process_event(self, event: Any) -> None:
        name, piece = event.data.get("name"), event.data.get("data")
        kept = sum(len(part) for part in self._file_buffer.get(name, ()))
        if piece is not None and kept + len(piece) > MOST:
            self._file_buffer.pop(name, None)
            return
        if piece is not None and event.data["chunk"] == 1:
            self.value.clear()
            self._file_buffer.clear()
        if piece is not None and event.data["chunk"] != 1 and name not in self._file_buffer:
            return
        super()._process_event(event)


class FilePane(Pane):
    """Readings from a file of the user's own."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self._instrument = instrument = bench.session.current.model.instrument
        self._folder = Path(tempfile.mkdtemp(prefix="bayescal-"))
        weakref.finalize(self, shutil.rmtree, self._folder, True)
        self._path: Path | None = None
        self._readings: Measurements | None = None
        self.drop = Upload(
            multiple=False,
            max_file_size=f"{MOST // 1_000_000}MB",
            previews=[],
            layout="compact",
            margin=0,
            sizing_mode="stretch_width",
            width=None,
            height=62,
            stylesheets=[INSIDE],
            chunk_size=4_000_000,
        )
        self.drop.param.watch(self._dropped, "value")
        self.told = words("", "table", styles={"overflow": "auto"}, sizing_mode="stretch_both")
        self.use = button(
            "Begin with these readings",
            lambda _: self._go_on(),
            color="primary",
            visible=False,
        )
        self.again = button("Read again", lambda _: self._read(), visible=False)
        self.mapping = download(
            "Save the mapping", callback=self._mapping, filename="mapping.toml", visible=False
        )
        self.form = row(visible=False)
        self._fields: dict[str, tuple[Any, Any]] = {}
        self._others = other_fields()
        intro = f"Drop a file of readings of {instrument.name}, up to {bytes_text(MOST)}; nothing leaves this computer."
        buttons = row(self.use, self.again, self.mapping)
        kinds = ("bare", "scrolls")
        left = column(words(intro, "small"), self.drop, buttons, self.form, kinds=kinds)
        self.view = halves(left, self.told, even=True)

    def _dropped(self, event: Any) -> None:
        if not event.new:
            return
        name, content = next(iter(event.new.items()))
        content = content.encode() if isinstance(content, str) else bytes(content)
        self.receive(str(name), content)

    def receive(self, name: str, content: bytes) -> None:
        """Take a file's content, and say what `calibrate` would."""
        if len(content) > MOST:
            self._say(f"{name[:80]} is larger than {bytes_text(MOST)}: give it on the command line")
            return
        self._path = self._folder / safe_name(name)
        self._path.write_bytes(content)
        self._fields = {}
        self.form.visible = False
        self._read()

    def _read(self) -> None:
        path, given = self._path, self.given()
        if path is None:
            return

        def job() -> tuple[Any, tuple[str, ...]]:
            try:
                return read(path, self._instrument, **given), headers_of(path)
            except InputError as error:
                return error, headers_of(path)

        self.bench.run(f"Reading {path.name} …", job, self._was_read)

    def _was_read(self, told: tuple[Any, tuple[str, ...]]) -> None:
        found, headers = told
        well = isinstance(found, Measurements)
        self._readings = found if well else None
        flags = "".join(f"\nwarning: {flag}" for flag in found.flags) if well else ""
        self._say(f"{len(found):,} readings\n{found}{flags}" if well else in_the_form(str(found)))
        self.use.visible = well
        self.again.visible = self.mapping.visible = bool(headers)
        if not self._fields and headers:
            self._make_form(headers)
        self.form.visible = bool(headers)

    def _say(self, text: str) -> None:
        self.told.object = text if len(text) <= TOLD else f"{text[:TOLD]}\n… and more"

    def _make_form(self, headers: tuple[str, ...]) -> None:
        """A line a column that the instrument reads: which of the file's it is, and in which unit."""
        pairs: list[Any] = []
        text = pn.widgets.TextInput
        for name, known in expected_columns(self._instrument).items():
            kind, how = pn.widgets.Select, {"options": [AS_FOUND, *headers]}
            if len(headers) > OFFERED:
                kind, how = text, {"placeholder": AS_FOUND}
            which = field(kind, f"{name} is", width=150, **how)
            unit = field(text, "in", placeholder="as in the file", width=100)
            unit.disabled = known.unit is None
            self._fields[name] = (which, unit)
            pairs.append(row(which, unit, kinds=("tight",)))
        self.form[:] = [*pairs, *self._others.values()]

    def given(self) -> dict[str, Any]:
        """What the form says, as arguments of `read`."""
        columns = {
            n: w.value for n, (w, _) in self._fields.items() if w.value not in ("", AS_FOUND, None)
        }
        units = {
            columns.get(n, n): u.value.strip()
            for n, (_, u) in self._fields.items()
            if u.value.strip()
        }
        others = {n: f.value for n, f in self._others.items() if f.value not in ("", None)}
        return {"columns": columns, "units": units, **others}

    def _mapping(self) -> BytesIO:
        path = self._folder / "mapping.toml"
        save_mapping(path, self.given())
        return BytesIO(path.read_bytes())

    def _go_on(self) -> None:
        if self._readings is not None:
            self.bench.begin_with(self._readings)


def other_fields() -> dict[str, Any]:
    """What `read` takes beside columns and units, by its names."""
    text, choose = pn.widgets.TextInput, pn.widgets.Select
    return {
        "nominal_scale": field(text, "nominal scale", placeholder="250 V/g", width=110),
        "nominal_zero": field(text, "nominal zero", placeholder="1.21 V", width=110),
        "local_gravity": field(
            pn.widgets.FloatInput, "local gravity [m/s²]", value=STANDARD_GRAVITY, width=130
        ),
        "missing": field(choose, "missing readings", options=list(MISSING_READINGS), width=110),
        "decimal": field(choose, "decimal sign", options={"as found": "", ".": ".", ",": ","}),
        "date_order": field(
            choose, "dates are", options={"as found": "", **{o: o for o in ORDERS}}
        ),
    }


def in_the_form(said: str) -> str:
    """What is wrong, in words of the form where it names options of the command line."""
    for option, instead in INSTEAD:
        said = re.sub(option, instead, said)
    return said


def safe_name(name: str) -> str:
    """A dropped file's name as the name of a file here: its last part, in letters that no system refuses."""
    last = re.sub(r"[^\w.+ -]", "_", name.replace("\\", "/").rpartition("/")[2])[-80:].strip(". ")
    return last if "." in last else f"readings-{last or 'without-name'}"


def headers_of(path: Path) -> tuple[str, ...]:
    """Names of a text file's columns; none where it cannot be opened."""
    if path.suffix.lower() not in (*TEXT, ".parquet", ".nc", ".xlsx", ".mat"):
        return ()
    try:
        return tuple(h.name for h in open_table(path, path.name).headers)
    except InputError:
        return ()
