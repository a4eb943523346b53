"""Import this before numpy: linear algebra on one thread.

numpy and scipy each start as many BLAS threads as cores, which on a busy two-core robot wait for each other: a gain
then takes tens of milliseconds instead of one, in a 100 Hz loop. ``OPENBLAS_NUM_THREADS`` overrides it.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
