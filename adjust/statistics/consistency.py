"""All parts of a survey and all changes within it, tested together at one error probability."""

from adjust.model.result import Adjustment
from adjust.statistics.changes import ChangeSearch
from adjust.statistics.condensed import CondensedSystem
from adjust.statistics.criteria import sidak
from adjust.statistics.parts import parts_of, parts_of_network, tested_parts
from adjust.statistics.result import Consistency

_ESTIMATED = ("estimated", "unseparable")


def consistency(
    adjustment: Adjustment, condensed: CondensedSystem | None, alpha: float = 0.05, changes: bool = True
) -> Consistency:
    """Test every part, and look for changes; ``alpha`` is the error probability of all of it together.

    condensed: the system of this adjustment; None for a network of pairs, of which the groups are tested. Where the
    global test fails because residuals are too large, every part is tested against the rest: else wrong sigmas would
    make everything suspect. Groups whose variance was estimated from these residuals are not tested for it.
    """
    test = adjustment.global_test
    if test is None:
        return Consistency(alpha, alpha, 0, (), (), False, 0)
    relative = test.status == "failed"
    system = None if condensed is None else condensed.system
    if condensed is None or adjustment.survey.is_pose_network:
        parts = parts_of_network(adjustment) if len(adjustment.groups) > 1 else ()
    else:
        parts = parts_of(adjustment, condensed.system, condensed.numbers)
    known = adjustment.variance_components
    fitted = {c.group for c in known.components if c.status in _ESTIMATED} if known is not None else set()
    parts = tuple(p for p in parts if not (p.kind == "group" and p.name in fitted))
    search = None
    if changes and condensed is not None and len(condensed.e):
        search = ChangeSearch(adjustment, condensed)
    n_changes = search.n_tests if search is not None else 0
    n = len(parts) + n_changes
    level = sidak(alpha, n) if n else alpha
    return Consistency(
        alpha, level, n, tested_parts(adjustment, parts, level, relative, system),
        search.found(level, relative) if search is not None else (), relative, n_changes,
        search.left_out() if search is not None else (),
    )  # fmt: skip
