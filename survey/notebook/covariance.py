"""A covariance by names, as a value that shows itself."""

from typing import Any

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from survey.notebook.frames import pandas
from survey.notebook.names import Cell, Component, heading, html_table
from survey.solution.quantities import correlations_in, sigmas_in


@frozen(eq=False)
class Covariance:
    """Joint covariance of components of estimates: ``matrix`` (n, n) in SI units, rad, px as ``units`` says.

    Of a pose ``a_from_b``: rotation rx ry rz (rad), then translation tx ty tz (m), small changes in frame b
    (``a_from_b * Exp(tangent)``). scaled: by sigma0 ** 2. It is an array where one is wanted: ``np.asarray(cov)``.

    >>> import numpy as np
    >>> names = ((("point", "A"), "x"), (("point", "B"), "x"))
    >>> cov = Covariance(names, ("m", "m"), np.array([[4.0, 1.0], [1.0, 1.0]]), False)
    >>> cov.sigmas.tolist()
    [2.0, 1.0]
    >>> cov.correlation.tolist()
    [[1.0, 0.5], [0.5, 1.0]]
    """

    components: tuple[Component, ...]
    units: tuple[str, ...]
    matrix: FloatArray
    scaled: bool

    @property
    def labels(self) -> tuple[str, ...]:
        """Names ``kind/id[/epoch]/component``, n."""
        return tuple("/".join((*name, component)) for name, component in self.components)

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations (n,)."""
        return sigmas_in(self.matrix)

    @property
    def correlation(self) -> FloatArray:
        """Correlation matrix (n, n); 0 where a sigma is 0."""
        return correlations_in(self.matrix)

    @property
    def frame(self) -> Any:
        """As a pandas data frame; raises SurveyError where pandas is not installed."""
        return pandas().DataFrame(self.matrix, index=self.labels, columns=self.labels)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        """The matrix."""
        return np.array(self.matrix, dtype=dtype) if copy or copy is None else np.asarray(self.matrix, dtype=dtype)

    def __len__(self) -> int:
        """Number of components."""
        return len(self.components)

    def __repr__(self) -> str:
        """Sigmas line by line."""
        lines = [f"{label}  sigma {s:.3g} {'' if unit == '1' else unit}".rstrip()
                 for label, s, unit in zip(self.labels, self.sigmas, self.units, strict=True)]  # fmt: skip
        return "\n".join([f"Covariance of {len(self)} components ({self._kind()})", *(f"  {x}" for x in lines)])

    def _kind(self) -> str:
        return "a posteriori, times sigma0²" if self.scaled else "a priori"

    def _repr_html_(self) -> str:
        """Sigmas and correlations, coloured by size."""
        rho, most = self.correlation, 40
        columns = ("", "sigma", "unit", *(f"{i + 1}" for i in range(min(len(self), most))))
        rows: list[list[Cell]] = []
        for i, label in enumerate(self.labels[:most]):
            cells = [_cell(x) for x in rho[i, :most]]
            rows.append([f"{i + 1} {label}", f"{self.sigmas[i]:.3g}", self.units[i], *cells])
        more = f", the first {most} shown" if len(self) > most else ""
        return heading(f"Covariance of {len(self)} components", f"{self._kind()}; correlations{more}") + html_table(
            columns, rows
        )


def _cell(rho: float) -> tuple[str, str]:
    colour = f"rgba({'33,102,172' if rho > 0 else '192,57,43'},{min(abs(rho), 1.0):.2f})"
    return f"{rho:+.2f}", f"background:{colour};{'color:#fff' if abs(rho) > 0.6 else ''}"
