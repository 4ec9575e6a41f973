"""What a user of GTSAM writes to solve a pose graph from file to file; run as a program of its own.

    python tests/benchmarks/gtsam_script.py FILE.g2o OUT.g2o [block-diagonal] [equal-start]

``readG2o``, the chordal start of ``InitializePose3``, Gauss-Newton, ``writeG2o``. equal-start:
with equal weights, for files whose own leave the chordal start without a solution. No covariances, tests or report.
"""

import sys

import gtsam
from gtsam import BetweenFactorPose3, InitializePose3, NonlinearFactorGraph, noiseModel


def main() -> None:
    """Print the steps, and v'Pv."""
    source, target, *how = sys.argv[1:]
    graph, given = gtsam.readG2o(source, True)
    if "block-diagonal" in how:
        graph = reweighted(graph, blocks)
    first = given.keys()[0]
    held = gtsam.PriorFactorPose3(first, given.atPose3(first), noiseModel.Isotropic.Sigma(6, 1e-4))
    graph.add(held)
    weighted = graph
    if "equal-start" in how:
        weighted = reweighted(graph, lambda _: noiseModel.Unit.Create(6))
        weighted.add(held)
    start = InitializePose3.initialize(weighted)
    parameters = gtsam.GaussNewtonParams()
    parameters.setRelativeErrorTol(1e-10)
    parameters.setAbsoluteErrorTol(1e-10)
    solver = gtsam.GaussNewtonOptimizer(graph, start, parameters)
    result = solver.optimize()
    gtsam.writeG2o(graph, result, target)
    print(f"{solver.iterations()} steps, v'Pv {2.0 * graph.error(result):.8g}")


def reweighted(graph, model) -> NonlinearFactorGraph:
    """The pairs with other weights, each made of what it has."""
    out = NonlinearFactorGraph()
    for factor in (graph.at(i) for i in range(graph.size())):
        if isinstance(factor, BetweenFactorPose3):
            out.add(BetweenFactorPose3(*factor.keys(), factor.measured(), model(factor.noiseModel())))
    return out


def blocks(model) -> noiseModel.Base:
    """Without the information between translation and rotation."""
    information = model.information()
    information[:3, 3:] = information[3:, :3] = 0.0
    return noiseModel.Gaussian.Information(information)


if __name__ == "__main__":
    main()
