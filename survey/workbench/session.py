"""A project in memory that is adjusted again at every decision: what ``labsurvey open`` serves, and a notebook uses.

>>> bench = Workbench("lab")          # or a project: Workbench(survey.read("lab"))
>>> bench.adjust()
>>> bench.exclude("X/hX05", reason="motion blur").largest[:5]
>>> bench.undo()
>>> bench.save()

Three sets are kept apart: what a table marks ``used = false``, what people excluded, and what a run screened out by
itself. Only the third is found anew by every adjustment, which begins at the values of everything that was ever solved.
"""

from survey.solution.earlier.changes import Changes, Snapshot, solution_changes
from survey.solution.earlier.runs import Run, load_run, pin_run
from survey.workbench import deciding, jobs
from survey.workbench.pictures import picture
from survey.workbench.resident import Resident
from survey.workbench.views import cameras, findings, project


class Workbench(Resident):
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
    run = project.run
    camera_view = cameras.camera_view
    lens_change = cameras.lens_change

    preview = deciding.preview
    exclude = deciding.exclude
    include = deciding.include
    decide = deciding.decide
    apply_remedy = deciding.apply_remedy
    set_sigma_scale = deciding.set_sigma_scale
    set_treatment = deciding.set_treatment
    set_datum = deciding.set_datum
    undo = deciding.undo
    redo = deciding.redo
    restore = deciding.restore

    save = jobs.save
    detect = jobs.detect
    plan = jobs.plan
    navigate = jobs.navigate
    add = jobs.add
    compare_with = jobs.compare_with
    cross_validate = jobs.cross_validate
    batch = jobs.batch

    def compare(self, a: int | None = None, b: int | None = None) -> Changes:
        """From run ``a`` to run ``b``, every parameter in sigmas of ``a``; None: the solution in memory."""
        return solution_changes(self._snapshot(a), self._snapshot(b))

    def _snapshot(self, number: int | None) -> Snapshot:
        return self.situation.solved.snapshot if number is None else load_run(self.folder, number)

    def pin(self, number: int, pinned: bool = True) -> Run:
        """Keep a run for ever, or no more. Raises SurveyError."""
        self.require_writable()
        return pin_run(self.folder, number, pinned)

    def picture(self, camera_id: str, epoch_id: str, size: int | None = None) -> tuple[bytes, str]:
        """An image as bytes and their media type, as :func:`survey.workbench.pictures.picture`."""
        return picture(self.situation.everything.images, (camera_id, epoch_id), size)
