"""Registration of the workbench annex: the command `workbench`. Heavy modules are imported on use."""

from __future__ import annotations

from pathlib import Path

from bayescal import workshop as ws


class WorkbenchCommand(ws.SearchRequest, ws.Command):
    """Run the calibration loop in a browser, step by step.

    It is served to this computer only, under a secret address.
    """

    example = "bayescal workbench readings.csv --instrument mems_gyro"
    out: Path = ws.opt(
        "Folder in which every step is saved; a session that is already in it is resumed.",
        Path("workbench_output"),
    )
    no_open: bool = ws.opt("Print the address, and open no browser.", False)

    def run(self) -> int:
        """Serve the workbench until Ctrl-C; the time limit applies to each search."""
        from bayescal._annexes.workbench.start import require_panel

        require_panel()
        # Unusable files raise an error before a browser opens.
        models, readings, holdout = ws.open_search([], self)
        effects = ws.load_effects(self, models[""].instrument, readings[""])
        with ws.create_result_folder(self.out) as folder:
            assert folder is not None
            ws.notify("loading the workbench and fitting the first model …")
            from bayescal._annexes.workbench.serve import serve
            from bayescal._annexes.workbench.session import Session
            from bayescal._annexes.workbench.session_store import FIRST_FOLDER, Origin

            effect_files = [] if self.effects_file is None else [self.effects_file]
            sources = self.files, self.holdout, self.read_options(), effect_files
            session = Session.open(
                models[""],
                readings[""],
                holdout=holdout.get(""),
                effects=effects,
                folder=folder / FIRST_FOLDER,
                origin=Origin.of(self.instrument, *sources, average=self.average),
                method=None if self.method == "marginal" else ws.create_method(self.method),
                reference={**ws.parse_numbers(self.reference, "--reference")} or None,
                time_limit=self.time_limit,
                **self.settings(),
            )
            files = ", ".join(p.name for p in self.files)
            serve(session, files, folder, open_browser=not self.no_open)
        print("bayescal workbench: ended", flush=True)
        return 0


ANNEX = {"commands": (WorkbenchCommand,)}
