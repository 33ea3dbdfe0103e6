"""Speed and memory of probtrack, beside its peers and beside the least such work could cost."""

import os

# before numpy and torch start their threads: everything here is timed on one
for _variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_variable] = "1"
