"""Many runs: searches of hyperparameters, their execution, and their results."""
