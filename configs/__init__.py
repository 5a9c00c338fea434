"""Values of the recipes, as Hydra YAML."""
