"""How many random cases a fuzz or race test tries, and the damage that several of them do."""

import os
import random
from contextlib import contextmanager

from hypothesis import HealthCheck, given, settings

from emmc_rig.drivers.errors import DriverError

FUZZ = int(os.environ.get("EMMC_FUZZ", "1"))
"""Factor on the number of cases of every fuzz and race test."""
DRIVER_CASES = 250


def fuzz(check, *strategies, cases=DRIVER_CASES):
    """Run a check on random cases: FUZZ times as many as stated; the same ones while FUZZ is 1."""
    chosen = settings(
        max_examples=cases * FUZZ,
        deadline=None,
        derandomize=FUZZ == 1,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
        database=None,
    )
    chosen(given(*strategies)(check))()


@contextmanager
def errors_of_the_driver_allowed():
    """Allow a `DriverError` of one line, and nothing else."""
    try:
        yield
    except DriverError as error:
        if "\n" in str(error):
            raise AssertionError("an error of more than one line") from error


def damage(data, seed):
    """Return the bytes with a few of them changed, lost, doubled or added."""
    generator = random.Random(seed)
    damaged = bytearray(data)
    for _ in range(generator.randrange(1, 5)):
        at = generator.randrange(len(damaged) + 1)
        match generator.randrange(5):
            case 0 if at < len(damaged):
                damaged[at] = generator.choice((0, 1, 0x7F, 0x80, 0xFF, generator.randrange(256)))
            case 1:
                del damaged[at : at + generator.randrange(1, 9)]
            case 2:
                damaged[at:at] = generator.randbytes(generator.randrange(1, 9))
            case 3:
                damaged[at:at] = damaged[at : at + 16]
            case _:
                del damaged[at:]
    return bytes(damaged)
