"""Speed of a batch of filters beside the same filter written by others and by hand."""

import os

# Before NumPy, which starts its threads when it is imported: all are measured on one processor.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
