"""The loops: pretrain, deploy, evaluate, and the rollouts they are made of."""
