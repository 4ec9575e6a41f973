"""Navigation of 60 epochs, of this checkout or of another: ``PYTHONPATH=FOLDER python tests/benchmarks/navigating.py``.

A head of three cameras turns among 60 beacons; spots with names, and without names and a tenth of them false.
"""

from time import process_time

import numpy as np

from adjust.navigation import navigate
from tests.adjust.navigation import Sight, mfns_head, scattered_beacons, simulated, turned

EPOCHS, ROUNDS = 60, 5


def milliseconds(named: bool) -> float:
    """Processor time of an epoch, the least of the rounds after a first one."""
    rng, head, beacons = np.random.default_rng(5), mfns_head(), scattered_beacons(60)
    sight = Sight(named=named, false_share=0.0 if named else 0.1)
    epochs = [simulated(head, beacons, turned(0.05 * i), rng, sight, f"e{i:03d}")[0] for i in range(EPOCHS)]
    times = []
    for _ in range(ROUNDS + 1):
        begin = process_time()
        navigate(head, beacons, epochs)
        times.append(process_time() - begin)
    return 1e3 * min(times[1:]) / EPOCHS


if __name__ == "__main__":
    for what in ("named", "without names"):
        print(f"{what}: {milliseconds(what == 'named'):.2f} ms an epoch")
