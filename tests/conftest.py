import torch as th

# Networks this small train no faster on two threads, and one thread always adds in the same order.
th.set_num_threads(1)
