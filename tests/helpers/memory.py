"""Memory use of a call, which reveals unchecked counts from damaged files."""

import os
import tracemalloc


def takes_less_than(limit, call):
    """Whether Python and NumPy hold fewer than ``limit`` bytes while ``call`` runs.

    It runs twice: here, so that it may return or raise something, and in a process of its own, where no other thread
    takes memory or is interrupted by the end of tracemalloc, which can crash Python 3.11 (gh-128679).
    """
    call()
    child = os.fork()
    if not child:
        fits = False
        try:
            tracemalloc.start()
            call()
            fits = tracemalloc.get_traced_memory()[1] < limit
        finally:
            os._exit(not fits)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
