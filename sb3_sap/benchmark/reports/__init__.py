"""Tables, figures and verdicts, made from the results of runs."""
