"""A robot that is not there: a process that speaks the robot's own protocol on this machine, with the task's scene."""
