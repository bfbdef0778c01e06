"""Mutants that change no behaviour, or only one that nobody needs: their ids, with the reason."""

from __future__ import annotations

COUNTS = "only equality of the counts before and after a request matters"
QUEUE = "any number of at least the depth of the topic's queue"
PERIOD = "any period far below the pulse and the latency"
TABLE = "the transition is in the table"
ENDED = "a stop and a deactivation also end the tap"
CLOCK = "the clock's time is greater than both"

REASONS: dict[str, str] = {
    "logic.permit:longest_hold:7:operand:1": "check-config refuses a cell that exceeds the limit",
    "logic.stops:StopLatch.__init__:6:value:0": COUNTS,
    "logic.stops:StopLatch.receive:8:operand:1": "no level is asserted unless a stop is latched",
    "logic.stops:StopLatch.try_reset:23:drop:0": "every new stop cancels the confirmation",
    "logic.tapper_commands:REFUSED_KEPT:0:value:0": QUEUE,
    "logic.tapper_commands:REFUSED_KEPT:0:value:1": QUEUE,
    "logic.tapper_commands:ReceivedCommands.refusal:14:value:0": CLOCK,
    "logic.tapper_commands:ReceivedCommands.note_refused:10:value:0": CLOCK,
    "logic.tapper_commands:ReceivedCommands.note_refused:11:operand:0": (
        "an id that is not new is refused in any case"
    ),
    "logic.standing_still:StandingStill.__init__:3:value:0": "set before the first request",
    "logic.standing_still:StandingStill.__init__:4:value:0": "ids are seconds of the clock",
    "logic.tap_cycle:look:7:operand:0": "an object that is not seen is not observed",
    "logic.tap_steps:try_another_way:11:member:0": "the outcome is set before",
    "logic.tapper_peers:TapperPeers.__init__:10:value:0": "set at the begin of each tap",
    "logic.planner:PlannerLogic.__init__:11:value:0": "any first number serves",
    "logic.planner:PlannerLogic._end:7:drop:0": TABLE,
    "logic.planner:PlannerLogic._go:2:false:0": TABLE,
    "logic.tapper:READ_PERIOD_S:0:value:1": "reading more often changes nothing",
    "logic.tapper:TapperLogic.check_charging:7:false:0": ENDED,
    "logic.tapper:TapperLogic.check_charging:7:operand:0": ENDED,
    "logic.tapper:TapperLogic.check_charging:7:operand:1": ENDED,
    "logic.tapper:TapperLogic._refusal:20:false:0": "the cycle gives the tap up at once",
    "logic.tapper:TapperLogic._job_done:20:true:0": "the last of the jobs' names",
    "logic.tapper:TapperLogic._job_failed:1:true:0": "set again by the next connection",
    "logic.arm_cycle:ArmCycle.checked:5:value:0": "all have four elements",
    "logic.tap_sender:TapSender.may_park:3:value:0": "both ids are 0 until the first withdrawal",
    "logic.tap_sender:TapSender.__init__:2:value:0": CLOCK,
    "logic.tap_sender:TapSender.__init__:3:value:0": CLOCK,
    "logic.tap_sender:TapSender.__init__:5:value:0": CLOCK,
    "logic.tap_sender:TapSender.next_id:10:value:0": "any greater id serves",
    "logic.tapper_cycle:TapperCycle._note_obstacle:4:operand:0": (
        "without an obstacle, its beginning is infinite"
    ),
    "logic.tapper_jobs:WINDOW_S:0:value:1": "the emulated board answers at once",
    "logic.tapper_jobs:_confirmed:5:operand:0": "another sentence about an unknown outcome",
    "hardware.tapper:LONGEST_CHARGE:0:value:0": (
        "a default argument, which no mutant of the constant changes"
    ),
    "hardware.tapper:TapperDriver.__init__:11:value:0": "every session draws its number",
    "hardware.tapper:TapperDriver.__init__:12:value:0": "any first number",
    "hardware.tapper:TapperDriver._greet:10:value:0": "any small number of tries",
    "hardware.output_tapper:WAIT:0:value:0": PERIOD,
    "hardware.output_tapper:WAIT:0:value:1": PERIOD,
    "hardware.output_tapper:OutputTapperDriver._reply:4:operand:0": (
        "every caller has checked that the guard was received"
    ),
}
