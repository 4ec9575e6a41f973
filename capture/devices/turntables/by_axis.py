"""Controllers of which every axis has one of its own, with an address of its own."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

from capture.devices.turntable import TurntableError


class ByAxis(ABC):
    """What such a ``Controller`` says and how it stops. signs, zeros: angle = sign * (controller's) + zero, rad."""

    modulo: float | None = None  # they count turns

    def __init__(self, addresses: Sequence[str], signs: Sequence[int], zeros: Sequence[float]) -> None:
        self._addresses, self._signs, self._zeros = tuple(addresses), tuple(signs), tuple(zeros)
        self.address = " ".join(addresses)

    def stop(self) -> None:
        """Stop every axis, the others too where one does not answer."""
        problem: TurntableError | None = None
        for axis in range(len(self._addresses)):
            try:
                self._stop(axis)
            except TurntableError as error:
                problem = error
        if problem is not None:
            raise problem

    @abstractmethod
    def _stop(self, axis: int) -> None:
        """Stop one."""
