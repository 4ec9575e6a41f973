"""What a congruence test of epochs gives back."""


from adjust.model.frozen import frozen
from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray
from adjust.statistics.result import Ellipsoid


@frozen
class CongruenceTest:
    """d' Q_d^+ d / (h s0^2) against Fisher's F(h, f), f = inf where sigma0 is taken as known (chi-square / h).

    freedom: h. freedom_sigma0: f. passed: p is not below the level.
    """

    statistic: float
    freedom: int
    freedom_sigma0: float
    p: float
    passed: bool


@frozen
class CongruenceStep:
    """One round of the search for stable points: ``name`` was taken out; what is left then tests as ``test``.

    share: what the point contributed to d' Q_d^+ d of the round before.
    """

    name: ParameterName
    share: float
    test: CongruenceTest


@frozen(eq=False)
class Motion:
    """How one point or station moved between two epochs, in the datum of the stable ones.

    displacement: (3,) m, world; cov (3, 3); ellipsoid at the level of one test. test: of the displacement (and rotation
    together for a station). rotation: (3,) rad, in the tangent of the station at the first epoch, with rotation_cov and
    rotation_test; None for points. stable: belongs to the reference. significant: at the family-wise level. smallest:
    m, displacement in the worst direction that would be found with the power of the test options. Where an epoch knows
    rotations alone displacement, cov and smallest are nan, and the ellipsoid has no axes.
    """

    name: ParameterName
    displacement: FloatArray
    cov: FloatArray
    ellipsoid: Ellipsoid
    test: CongruenceTest
    rotation: FloatArray | None
    rotation_cov: FloatArray | None
    rotation_test: CongruenceTest | None
    stable: bool
    significant: bool
    smallest: float


@frozen(eq=False)
class Congruence:
    """Two epochs compared. epochs: their names. alpha: of the global test, and of all single tests together.

    sigma0: pooled a posteriori sigma0 and its redundancy; with ``scaled`` False it is 1 and the redundancy inf.
    ratio_p: of the F-test that both epochs have the same variance factor. before: test of all points together; after:
    of the stable ones. steps: how these were found. datum: the motions that the comparison leaves out (tx ty tz rx ry
    rz scale), because at least one epoch does not determine them. motions: stable ones last. warnings: for people.
    """

    epochs: tuple[str, str]
    alpha: float
    scaled: bool
    sigma0: float
    redundancy: float
    ratio_p: float
    before: CongruenceTest
    after: CongruenceTest
    steps: tuple[CongruenceStep, ...]
    stable: tuple[ParameterName, ...]
    moved: tuple[ParameterName, ...]
    datum: tuple[str, ...]
    motions: tuple[Motion, ...]
    warnings: tuple[str, ...]
