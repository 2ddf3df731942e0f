"""What the robot's client reports, in words that say what to do."""

TODO = {
    "UserStopped": "Release the stop button",
    "Guiding": "Let go of the guiding buttons",
    "Other": "Unlock the joints and activate FCI in Desk",
    "Reflex": "Look at the robot and clear the error in Desk",
}


def explain(error: Exception, ip: str, what: str = "robot") -> str:
    """One line about an error of franky, for the robot, or its gripper, at an address."""
    kind, text = type(error).__name__, first_line(error)
    if kind == "IncompatibleVersionException":
        return (
            f"the robot's firmware does not go with this client ({text}). FR3 firmware 5.9 or newer is needed; for "
            "older ones install the client that fits your robot server version, as the FAQ of franky says."
        )
    if kind == "RealtimeException":
        return f"{text}. backend.arm.realtime=ignore runs without a real-time kernel."
    if kind == "NetworkException" or "Net Exception" in text:
        return f"the connection to the {what} at {ip} was lost ({text})"
    if "safety function" in text:
        return f"{not_ready('UserStopped')} ({text})"
    return text


def not_ready(mode: str) -> str:
    """What a person must do about a robot in a mode that does not move."""
    return f"the robot is not ready (mode {mode}). {TODO.get(mode, 'Look at it in Desk')}, then go on."


def first_line(error: Exception) -> str:
    """The first line of an error's text, or its kind if it has none."""
    text = str(error).strip().splitlines()
    return (text[0] if text else type(error).__name__).removeprefix("libfranka: ")
