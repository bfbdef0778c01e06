"""What to do about each code of ``tapping_cell_msgs/ErrorCode``: the one table of hints.

``docs/error_codes.md`` shows it; a test holds it to the codes of the messages package.
"""

from __future__ import annotations

HINTS: dict[int, tuple[str, str]] = {
    0: ("NONE", ""),
    # the goal, or what was asked
    101: (
        "GOAL_NOT_FINITE",
        "Send numbers; look for a division by zero or an unset field in the sender.",
    ),
    102: ("GOAL_WRONG_FRAME", "Set header.frame_id to table and give the pose in that frame."),
    103: (
        "GOAL_OFF_TABLE",
        "Send a goal farther inside, or correct table.length and table.width in the cell file.",
    ),
    104: (
        "GOAL_OUT_OF_REACH",
        "Send a goal nearer to the arm, or correct the arm's base, dimensions and limits in the "
        "cell file.",
    ),
    105: ("GOAL_IN_KEEP_OUT", "Send a goal outside the keep-outs of the cell file."),
    106: ("GOAL_STALE", "Synchronise the clocks of both machines, or leave the stamp zero."),
    107: (
        "GOAL_BAD_TOLERANCE",
        "Give tolerances above the camera's noise, or 0 for the cell's own.",
    ),
    108: ("GOAL_NOT_PLANAR", "Give z 0 and a rotation about z only."),
    109: ("GOAL_BAD_ORIENTATION", "Normalise the quaternion; all zeros is none."),
    110: (
        "GOAL_REPLACED",
        "Nothing: wait for a goal's end before the next one is sent, to keep it.",
    ),
    111: ("GOAL_CANCELED", "Nothing: send the goal again when it is wanted."),
    112: ("GOAL_BAD_TAP_LIMIT", "Ask for fewer taps, or raise goal.max_taps in the cell file."),
    121: (
        "TRAJECTORY_INVALID",
        "Name the joints shoulder, elbow, quill and tool, with rising times.",
    ),
    122: ("COMMAND_INVALID", "Give the pose in the frame table and finite numbers above 0."),
    123: ("COMMAND_REPEATED", "Nothing, or use a tap id above every earlier one."),
    # configuration
    201: (
        "CONFIGURATION_INVALID",
        "Correct the value that the sentence names; check-config shows all.",
    ),
    202: (
        "CONFIGURATION_UNKNOWN_KEY",
        "Correct the key's spelling; the sentence lists the known ones.",
    ),
    203: ("CONFIGURATION_MISSING_KEY", "Add the key; the sentence says what it is and its range."),
    204: ("CONFIGURATION_UNREADABLE", "Give the path of a YAML file that can be read."),
    205: (
        "CONFIGURATION_CONFLICT",
        "Make the two settings agree; check-config shows all conflicts.",
    ),
    # seeing
    301: (
        "OBJECT_NOT_SEEN",
        "Uncover the object's marker, put it into view, and compare its id and dictionary with "
        "the object file.",
    ),
    302: ("REFERENCES_NOT_SEEN", "Uncover at least two reference markers, and light them evenly."),
    303: (
        "CAMERA_SILENT",
        "Look after the camera, its cable and its node; camera/image_raw must come.",
    ),
    304: ("CAMERA_INFO_MISMATCH", "Calibrate for the resolution in use: calibrate camera."),
    305: (
        "OBJECT_NOT_AT_REST",
        "Hold nothing against the object; look for vibration or a sloping table.",
    ),
    306: ("CAMERA_MOVED", "Fix the camera and the markers, then calibrate: calibrate table."),
    307: (
        "IMAGE_INVALID",
        "Set exposure and light so that the markers are neither black nor white; the encodings "
        "are mono8, bgr8 and rgb8.",
    ),
    308: ("CAMERA_NOT_CALIBRATED", "Calibrate the lens: calibrate camera."),
    309: ("MARKER_AMBIGUOUS", "Take away every other marker with the object's id."),
    310: (
        "CAMERA_UNAVAILABLE",
        "Check the path of the device, its rights, and that nobody else has it.",
    ),
    311: ("OBJECT_MOVED", "Keep hands off the object between taps, then send the goal again."),
    312: ("OBJECT_OFF_TABLE", "Put the object back into the table's area."),
    313: ("STAMP_INVALID", "Synchronise the clocks; look for two cameras on one topic."),
    314: ("TOO_FEW_FRAMES", "Raise the camera's rate, or lower frames_needed of tap_planner."),
    # planning
    401: (
        "NO_TAP_FOUND",
        "Put the object somewhere more open, or send a goal nearer to the middle.",
    ),
    402: (
        "TAP_LIMIT_REACHED",
        "Send the goal again; where that happens often, calibrate arm and tapper.",
    ),
    403: (
        "TAP_WITHOUT_EFFECT",
        "Look whether the striker reaches the object at the right height; then calibrate arm and "
        "tapper.",
    ),
    404: ("PLANNER_UNKNOWN", "Choose one of the methods that the sentence lists."),
    405: (
        "SOLVING_FAILED",
        "Send the goal again with another planner, and report it with the run folder.",
    ),
    406: (
        "TAP_UNEXPECTED",
        "Look for an obstacle or a wrong object file, then fit the object: fit.",
    ),
    407: ("NOT_CONVERGING", "Calibrate arm and tapper, and fit the object's friction: fit."),
    408: (
        "DEADLINE_EXCEEDED",
        "Look at what the sentence names; raise its deadline where it is slow.",
    ),
    409: ("PLANNER_BUSY", "Wait until the goal under way has ended, or cancel it."),
    410: ("TAP_LEAVES_TABLE", "Move the object to the middle, or ask for a slower tap."),
    411: (
        "TAP_LEAVES_VIEW",
        "Move the object to the middle of the picture, or ask for a slower tap.",
    ),
    # the arm
    501: (
        "ARM_NOT_CONNECTED",
        "Check power, cable, and arm.port in the cell file; the driver reconnects.",
    ),
    502: ("ARM_NOT_HOMED", "Home it: call the service scara_arm/home."),
    503: ("ARM_ALARM", "Free the arm, look up the firmware's number, then clear_fault and home."),
    504: (
        "ARM_TIMEOUT",
        "Free the arm; look for a crawling speed or a lost line, then clear_fault.",
    ),
    505: ("ARM_OUT_OF_REACH", "Ask for a pose within the arm's reach."),
    506: (
        "ARM_JOINT_LIMIT",
        "Ask for a pose within the joints' limits, or correct arm.lower, arm.upper.",
    ),
    507: (
        "ARM_POSITION_MISMATCH",
        "Look for an obstacle or lost steps, then clear_fault and home.",
    ),
    508: ("ARM_STOPPED", "Make the cell safe, then call the service scara_arm/clear_fault."),
    509: ("ARM_SILENT", "Start scara_arm, or look at its log."),
    510: (
        "ARM_FIRMWARE_UNKNOWN",
        "Check arm.port and arm.dialect: another device may be on this port.",
    ),
    511: ("ARM_REPLY_GARBLED", "Check arm.baud, cable and grounding."),
    512: ("ARM_BUSY", "Wait until the arm is idle, then ask again."),
    513: ("ARM_COLLISION_RISK", "Ask for a path that keeps clear of object, table and keep-outs."),
    514: (
        "ARM_COMMAND_EXPIRED",
        "Look for a slow machine or clocks that differ; the planner looks again.",
    ),
    # the tapper
    601: (
        "TAPPER_NOT_CONNECTED",
        "Check power, cable, and tapper.port in the cell file; it reconnects.",
    ),
    602: ("TAPPER_INTERLOCK_OPEN", "Close the tapper's interlock."),
    603: (
        "TAPPER_STOPPED",
        "Make the cell safe, press the tapper's button, then call the service "
        "tapper_trigger/clear_fault.",
    ),
    604: ("TAPPER_TIMEOUT", "Look whether the striker moves freely, then clear_fault."),
    605: ("TAPPER_SPENT", "Nothing: a new tap gets a new id."),
    606: (
        "TAPPER_SPEED_OUT_OF_RANGE",
        "Ask for a speed on the curve of the cell file, or calibrate tapper.",
    ),
    607: ("TAPPER_OUTCOME_UNKNOWN", "Look at the object; never fire the same tap again."),
    608: ("TAPPER_SILENT", "Start tapper_trigger, or look at its log."),
    609: ("TAPPER_RESET", "Look after its power supply; the planner looks and goes on."),
    610: ("TAPPER_COMMAND_EXPIRED", "Nothing: the tap was not fired; the planner looks again."),
    611: ("TAPPER_FAULT", "Look at the tapper, then call the service tapper_trigger/clear_fault."),
    612: ("TAPPER_FIRMWARE_UNKNOWN", "Check tapper.port, and flash the firmware of this version."),
    613: ("TAPPER_REPLY_GARBLED", "Check tapper.baud, cable and grounding."),
    614: ("TAPPER_ARM_NOT_IN_POSITION", "Look after the arm; the planner gives this tap up."),
    615: ("TAPPER_BUSY", "Wait until the tapper is safe again."),
    616: ("TAPPER_SPEED_MISMATCH", "Calibrate tapper; look for friction in the striker's guide."),
    # the whole cell
    901: (
        "EMERGENCY_STOP",
        "Make the cell safe, release the stop, then clear_fault arm and tapper.",
    ),
    902: ("NOT_READY", "Start what is missing; the sentence names it."),
    903: ("NOT_ACTIVE", "Activate the node, or leave its parameter autostart on."),
    904: ("INTERNAL", "Report it with the run folder and the log."),
    905: ("CLOCK_JUMPED", "Send the goal again; keep the clock from jumping."),
    906: ("SHUTTING_DOWN", "Start the node again."),
    907: ("WORLD_UNAVAILABLE", "Wait until sim_world is active, or ask for what its table holds."),
    908: (
        "RECORDING_FAILED",
        "Make room on the disk, or set the parameter folder to one that can be written; the goal "
        "itself goes on.",
    ),
    909: (
        "CLOCKS_DIFFER",
        "Synchronise the clocks of the computers, with chrony for example.",
    ),
    910: (
        "ENABLING_RELEASED",
        "Hold the enabling device while the cell works, or leave set-up mode.",
    ),
}
"""Name and hint of each code, in imperative; the hint is empty where there is nothing to do."""


def hint(code: int) -> str:
    """What to do about a code; empty where there is nothing, or the code is not known."""
    return HINTS.get(code, ("", ""))[1]


def name(code: int) -> str:
    """The name of a code; its number where it is not known, as in a bag of a later version."""
    return HINTS[code][0] if code in HINTS else str(code)
