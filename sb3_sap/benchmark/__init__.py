"""The paper's experiments and their comparison with today's algorithms: runs, and reports of them."""
