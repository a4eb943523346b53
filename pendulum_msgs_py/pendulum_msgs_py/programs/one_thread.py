"""Import this before numpy in a program: linear algebra on one thread.

Matrices here have a handful of rows. numpy and scipy each bring a pool of BLAS threads as large as the machine, and on
a busy two-core robot the pools wait for each other: a gain then takes tens of milliseconds to design instead of one, in
the middle of a 100 Hz loop. ``OPENBLAS_NUM_THREADS`` overrides it.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
