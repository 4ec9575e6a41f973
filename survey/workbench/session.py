"""A project in memory that is adjusted again at every decision: what ``labsurvey open`` serves, and a notebook uses.

>>> bench = Workbench("lab")          # or a project: Workbench(survey.read("lab"))
>>> bench.adjust()
>>> bench.exclude("X/hX05", reason="motion blur").largest[:5]
>>> bench.undo()
>>> bench.save()

Three sets are kept apart: what a table marks ``used = false``, what people excluded, and what a run screened out by
itself. Only the third is found anew by every adjustment, which begins at the values of everything that was ever solved.
"""

from dataclasses import replace

from survey.jobs.excluding import FILE, author_name
from survey.project.exclusions import Row
from survey.project.project import DEFINITION_FILE
from survey.solution.earlier.changes import Changes, Snapshot, solution_changes
from survey.solution.earlier.runs import Run, definition_of, find_run, load_run, pin_run
from survey.workbench.jobs import Jobs
from survey.workbench.pictures import picture
from survey.workbench.views import cameras, findings, project


class Workbench(Jobs):
    """A project or its folder, kept in memory; see the module. Every method may be called from any thread.

    read_only: nothing is ever written. watch: called with (iteration, v'Pv) while something is adjusted.
    """

    state = project.state
    points = project.points
    readings = project.readings
    parameters = project.parameters
    findings = findings.findings
    scene = project.scene
    loops = project.loops
    network = project.network
    table_residuals = project.table_residuals
    statistics_part = project.statistics_part
    runs = project.runs
    camera_view = cameras.camera_view
    lens_change = cameras.lens_change

    def restore(self, number: int, base: int | None = None) -> tuple[str, ...]:
        """survey.toml and exclusions as they were at a run, as one decision; what else has changed since, for people.

        Raises as :meth:`exclude`, and where there is no such run.
        """
        with self._lock:
            self._check(base)
            run, text, now = find_run(self.folder, number), definition_of(self.folder, number), self.situation
            then = {e.name: e for e in run.exclusions}
            who = author_name(now.project.options.identification)
            why = f"run {number}"
            rows = [Row(True, replace(e, line=0)) for name, e in then.items() if name not in now.exclusions]
            rows += [Row(False, replace(e, reason=why, author=who)) for n, e in now.exclusions.items() if n not in then]
            texts = {DEFINITION_FILE: text} if text != now.definition_text else {}
            if rows or texts:
                self._decided(rows, texts, f"restore run {number}")
            inputs = self.situation.everything.inputs
            other = sorted(k for k in {*inputs, *run.hashes} if inputs.get(k) != run.hashes.get(k))
            known = {DEFINITION_FILE, FILE}
            return tuple(f"{name}: is not as it was at run {number}; it stays as it is" for name in other
                         if name not in known)  # fmt: skip

    def compare(self, a: int | None = None, b: int | None = None) -> Changes:
        """From run ``a`` to run ``b``, every parameter in sigmas of ``a``; None: the solution in memory."""
        return solution_changes(self._snapshot(a), self._snapshot(b))

    def _snapshot(self, number: int | None) -> Snapshot:
        return self.situation.solved.snapshot if number is None else load_run(self.folder, number)

    def pin(self, number: int, pinned: bool = True) -> Run:
        """Keep a run for ever, or no more. Raises SurveyError."""
        self._require_writable()
        return pin_run(self.folder, number, pinned)

    def picture(self, camera_id: str, epoch_id: str, size: int | None = None) -> tuple[bytes, str]:
        """An image as bytes and their media type, as :func:`survey.workbench.pictures.picture`."""
        return picture(self.situation.everything.images, (camera_id, epoch_id), size)
