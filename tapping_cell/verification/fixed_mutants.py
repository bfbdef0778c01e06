"""Defects of the positioning cell that its invariants must detect; see ``mutants``."""

from __future__ import annotations

from tapping_cell.verification.mutants import Mutant

BOARDS = "tapping_cell.hardware.tapper_boards"
TAPPER = "tapping_cell.logic.tapper"
PEERS = "tapping_cell.logic.tapper_peers"

FIXED_MUTANTS: tuple[Mutant, ...] = (
    Mutant(
        "charges a board without asking the others",
        BOARDS,
        "others = self._require_rest(board)",
        "others: list[Reply] = []",
        also=Mutant(
            "fires a board without asking the others",
            BOARDS,
            "            self._require_rest(self._charged)\n",
            "            pass\n",
        ),
        kinds=("striker out in a freeze",),
        fixed=True,
    ),
    Mutant(
        "fires however old the other boards' replies are",
        BOARDS,
        "driver.now() - asked_at <= OTHERS_ASKED_S and still_allowed(by)",
        "still_allowed(by)",
        kinds=("striker out in a freeze",),
        fixed=True,
    ),
    Mutant(
        "fires another board's channel",
        BOARDS,
        "board, own = divmod(channel, CHANNELS_PER_BOARD)",
        "board, own = 0, channel % CHANNELS_PER_BOARD",
        kinds=("cancel",),
        fixed=True,
    ),
    Mutant(
        "fires the next channel",
        TAPPER,
        "            self._channels[tapper],\n",
        "            self._channels[tapper] ^ 1,\n",
        kinds=("cancel",),
        fixed=True,
    ),
    Mutant(
        "sends a stop to the first board only",
        BOARDS,
        "all([driver.stop() for driver in self._drivers])",
        "self._drivers[0].stop()",
        kinds=("emergency stop", "stop service"),
        fixed=True,
    ),
    Mutant(
        "hides the switches of further boards",
        BOARDS,
        "reply.at_mounts << cell_channel(board, 0) for board, reply in enumerate(replies)",
        "(reply.at_mounts if not board else 0xFF) << cell_channel(board, 0)"
        " for board, reply in enumerate(replies)",
        also=Mutant(
            "takes the state of the charged board for that of all",
            BOARDS,
            "state=min((reply.state for reply in replies), key=PRECEDENCE.index),",
            "state=own.state,",
        ),
        kinds=("striker stays out",),
        fixed=True,
    ),
    Mutant(
        "fires at an object in motion",
        PEERS,
        "if self._mounts is not None and not seen.at_rest:",
        "if False:",
        kinds=("object creeps",),
        fixed=True,
    ),
    Mutant(
        "assumes that a striker has returned",
        TAPPER,
        "            self._machine.move(Event.RELEASED, S.RETURNING)\n"
        '            self._run("return", tapper_jobs.wait_for_return)\n',
        "            self._machine.move(Event.ENDED, S.SAFE)\n",
        kinds=("striker stays out", "striker blocked"),
        fixed=True,
    ),
)
