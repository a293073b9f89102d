"""Memory use of a call, which reveals unchecked counts from damaged files."""

import os
import tracemalloc


def takes_less_than(limit, call):
    """Whether Python and NumPy hold fewer than ``limit`` bytes while ``call`` runs, here and in a process of its own.

    There, the end of tracemalloc, which can crash Python 3.11 (gh-128679), interrupts no other thread.
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
