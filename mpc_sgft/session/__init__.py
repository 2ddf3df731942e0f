"""The person at the robot: keys, page, verdicts, takeover."""
