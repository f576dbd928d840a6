"""Before numpy is imported: matrices are small, and more threads only wait for each other."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
