"""``python -m sb3_sap.zoo train …`` is ``sb3-sap train …``."""

import sys

import torch as th

from sb3_sap.zoo import main

if __name__ == "__main__":
    th.set_num_threads(1)
    sys.exit(main())
