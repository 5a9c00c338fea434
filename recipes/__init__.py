"""Entry points: demonstrations, maps, reinforcement learning, evaluation. Where `nht` and `nht.envs` meet."""
