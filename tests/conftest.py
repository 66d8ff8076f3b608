import os

# Results are compared to the bit, which requires one device: the CPU. `test_cuda.py` makes the GPU visible again.
os.environ["SB3_SAP_TEST_GPUS"] = os.environ.get("CUDA_VISIBLE_DEVICES", "all")
os.environ["CUDA_VISIBLE_DEVICES"] = ""

import torch as th

# Networks this small train no faster on two threads, and one thread always adds in the same order.
th.set_num_threads(1)
