"""Records demonstrations, and reads those of others."""
