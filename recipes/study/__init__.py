"""Many runs: what is searched, who runs it, what came out."""
