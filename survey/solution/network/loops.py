"""The loops of the measured pairs of a survey one by one: how well they close, before and after the adjustment.

Through what is known without pairs too, as :mod:`survey.solution.network.counts` counts them.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Survey
from adjust.observations.pair_arrays import PairArrays, pair_arrays
from adjust.pose_network.loops import loop_vectors
from adjust.relay.closed import play
from adjust.relay.loops import LoopMisclosures, loop_misclosures
from adjust.relay.network import MeasuredPairs, topology
from adjust.spatial.rigid_motions import Motions
from survey.solution.network.counts import ends_of, links_of, measured_only, tied
from survey.solution.network.pairs import pair_rows
from survey.solution.quantities import ARCSEC_PER_RAD
from survey.solution.records import Column, Entries

ALPHA = 0.001
"""Error probability of the test of all loops together."""


def pair_loops(survey: Survey) -> LoopMisclosures | None:
    """How well every independent loop of all measured pairs closes, used or not; None where there is no pair.

    Of pairs with and without translation the rotations alone.
    """
    pairs = survey.pairs
    if not pairs:
        return None
    measured, ends = pair_arrays(pairs), ends_of(pairs)
    dim = 6 if measured.is_pose.all() else 3
    links, covs = links_of(survey, pairs, ends, dim), [measured.cov[:, :dim, :dim]]
    for given in (link.given for link in links):
        held = given.treatment == "held" or given.prior_cov is None
        covs.append((np.zeros((dim, dim)) if held else np.asarray(given.prior_cov)[:dim, :dim])[None])
    motions = _with_given(measured, [link.given.value or Pose3() for link in links], dim)
    return loop_misclosures(MeasuredPairs(tied(ends, links), motions, np.concatenate(covs)))


def _with_given(measured: PairArrays, given: Sequence[Pose3], dim: int) -> Motions:
    """Measured pairs and then what is known without them; of poses the rotations alone where ``dim`` is 3."""
    R = np.concatenate([measured.rotations, *(p.rotation().matrix()[None] for p in given)])
    if dim == 3:
        return Motions(R)
    return Motions(R, np.concatenate([measured.translations, *(p.translation()[None] for p in given)]))


def loops_after(adjustment: Adjustment, loops: LoopMisclosures) -> FloatArray:
    """Misclosures (L, dim) of the same loops by the adjusted pairs, predicted where not used; a mount keeps its play.

    loops: of :func:`pair_loops`, the pairs of the survey first. From the residuals: each pair as measured, moved by its
    own. Nan where a pair has none.
    """
    basis, survey = loops.basis, adjustment.survey
    top, dim = basis.topology, loops.vector.shape[1]
    n, given = len(survey.pairs), list[Pose3]()
    if top.n_pairs > n:  # what is given: its adjusted pose, where it is known no better than that
        links = {link.link_id: link for link in links_of(survey, survey.pairs, ends_of(survey.pairs), dim)}
        for link in (links[i] for i in top.pair_ids[n:]):
            estimate = adjustment.estimates.get(link.parameter)
            now = None if estimate is None else estimate.value
            given.append(now if isinstance(now, Pose3) else link.given.value or Pose3())
    row, found = pair_rows(adjustment), adjustment.other_arrays
    mounts = {closure.pair_ids[-1] for closure in survey.closures}
    moved, lost = np.zeros((top.n_pairs, dim)), np.zeros(top.n_pairs, dtype=np.bool_)
    lost[:n] = row < 0
    there, first = np.flatnonzero(row >= 0), np.cumsum(found.n_components) - found.n_components
    moved[there] = found.residual[first[row[there], None] + np.arange(dim)]
    for e in (e for e in there.tolist() if survey.pairs[e].pair_id in mounts):
        v = found.residual[first[row[e]] : first[row[e]] + found.n_components[row[e]]]
        moved[e] -= play(survey.closures, survey.pairs[e], v)[:dim]
    w = loop_vectors(basis, _with_given(pair_arrays(survey.pairs), given, dim).retract(moved))
    w[np.logical_or.reduceat(lost[basis.pair_idx], basis.ptr[:-1])] = np.nan
    return w


def loops_dict(
    loops: LoopMisclosures, left_out: Sequence[str] = (), after: FloatArray | None = None, form: str = "poses",
    solved_by: str = "poses",
) -> dict[str, Any]:
    """The loops, worst first, as plain values; left_out: pairs that are not used, named beside the loops they are in.

    sigma_misclosure: along the direction of the misclosure. after: misclosures (L, dim) by the adjusted pairs. form:
    "poses" or "closed", as asked for. solved_by: "poses" or "conditions", how the pairs were adjusted.
    """
    failed = np.zeros(len(loops.test), dtype=np.bool_)
    failed[loops.failed(ALPHA)] = True
    order = np.argsort(loops.p_value, kind="stable")
    columns = misclosure_columns(loops.vector, loops.cov)
    columns |= {"test": loops.test, "p_value": loops.p_value}
    if after is not None:
        columns |= {key: size for key, _, size in _lengths("misclosure_after", after)}
    tree: dict[str, Column] = {**_walks(loops, order.tolist(), left_out), "closes": ~failed[order]}
    tree |= {key: column[order] for key, column in columns.items()}
    return {
        "n_loops": len(order),
        "n_failed": int(failed.sum()),
        "n_listed": len(order),
        "minimal": loops.basis.minimal,
        "note": loops.basis.note,
        "alpha": ALPHA,
        "form": form,
        "solved_by": solved_by,
        "worst_first": Entries(tree, len(order)),
    }


def closures_dict(adjustment: Adjustment) -> dict[str, Any]:
    """Every loop through a mount: its misclosure as measured, and the play of the mount that the adjustment leaves.

    sigma: of the mount, as given. play_over_sigma: length of the play over its sigmas, of dim components.
    """
    survey, out = adjustment.survey, {}
    every, number = pair_arrays(survey.pairs), {p.pair_id: e for e, p in enumerate(survey.pairs)}
    of_pairs = adjustment.other_residuals if survey.closures else ()
    found = {o.ids[0]: np.asarray(o.residual) for o in of_pairs if o.kind == "pair"}
    for closure in survey.closures:
        rows = [number[i] for i in closure.pair_ids]
        pairs, dim = [survey.pairs[e] for e in rows], 6 if every.is_pose[rows].all() else 3
        motions = Motions(every.rotations[rows], every.translations[rows] if dim == 6 else None)
        loop = loop_misclosures(MeasuredPairs(topology(ends_of(tuple(pairs))), motions, every.cov[rows, :dim, :dim]))
        entry: dict[str, Any] = {"pairs": list(closure.pair_ids), "used": pairs[-1].used}
        entry |= {"sigma_arcsec": ARCSEC_PER_RAD * closure.rotation_sigma, "sigma_mm": 1e3 * closure.translation_sigma}
        entry |= {key: float(of[0]) for key, of in misclosure_columns(loop.vector, loop.cov).items()}
        entry |= {"test": loop.test[0], "freedom": dim, "p_value": loop.p_value[0]}
        v = found.get(closure.pair_ids[-1])
        if v is not None:
            d = play(survey.closures, pairs[-1], v)
            entry["play_arcsec"] = float(ARCSEC_PER_RAD * np.linalg.norm(d[:3]))
            entry |= {"play_mm": float(1e3 * np.linalg.norm(d[3:]))} if len(d) == 6 else {}
            sigma = np.sqrt(np.diag(closure.cov(len(d))))
            entry["play_over_sigma"] = float(np.linalg.norm(d[sigma > 0.0] / sigma[sigma > 0.0]))
        out[closure.closure_id] = entry
    return out


def _walks(loops: LoopMisclosures, order: Sequence[int], left_out: Sequence[str]) -> dict[str, Column]:
    """What loops lead through, in this order, and of how many components each is."""
    out = frozenset(left_out)
    stations, pairs = loops.basis.all_stations, loops.basis.all_pairs
    every = len(measured_only(loops.basis.topology.pair_ids)) == loops.basis.topology.n_pairs
    measured = [list(pairs[k] if every else measured_only(pairs[k])) for k in order]
    return {
        "stations": [list(stations[k]) for k in order],
        "pairs": measured,
        "pairs_not_used": [[p for p in ids if p in out] for ids in measured] if out else [[]] * len(measured),
        "freedom": np.full(len(measured), loops.vector.shape[1]),
    }


def _lengths(name: str, w: FloatArray) -> Iterator[tuple[str, slice, FloatArray]]:
    """Of the parts of misclosures (L, 3 or 6): key with its unit, components, lengths (L,) in that unit."""
    parts = (("arcsec", slice(3), ARCSEC_PER_RAD), ("mm", slice(3, 6), 1e3))
    for unit, of, factor in parts[: w.shape[1] // 3]:
        yield f"{name}_{unit}", of, factor * np.linalg.norm(w[:, of], axis=1)


def misclosure_columns(w: FloatArray, cov: FloatArray) -> dict[str, FloatArray]:
    """Lengths (L,) of misclosures (L, 3 or 6), and their sigmas along them; of none at all, the mean sigma."""
    out: dict[str, FloatArray] = {}
    for key, of, size in _lengths("misclosure", w):
        part, C = w[:, of], cov[:, of, of]
        length = np.linalg.norm(part, axis=1)
        along = np.einsum("li,lij,lj->l", part, C, part) / np.where(length > 0.0, length, 1.0) ** 2
        variance = np.where(length > 0.0, along, np.trace(C, axis1=1, axis2=2) / 3.0)
        factor = ARCSEC_PER_RAD if key.endswith("_arcsec") else 1e3
        out |= {key: size, f"sigma_{key}": factor * np.sqrt(variance)}
    return out
