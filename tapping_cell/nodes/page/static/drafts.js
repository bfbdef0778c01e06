"use strict";
// Goals that the operator has placed. The node keeps them, so that they survive a reload and every
// page shows them.

const DRAFT_DELAY_MS = 300;   // time without a change after which the goals are sent
const DRAFT_QUIET_MS = 1500;  // time after an own change in which other pages' goals are not taken

class Drafts {
  constructor(rows) {
    this.rows = rows;          // returns the rows of the arrangement
    this.changedAt = -Infinity;
    this.timer = 0;
    this.known = "";
  }

  changed() {
    this.changedAt = performance.now();
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.send(), DRAFT_DELAY_MS);
  }

  send() {
    const rows = [...this.rows()];
    if (rows.some((row) => row.ghost.waiting || row.ghost.hold)) {
      this.changed();
      return;
    }
    const goals = rows.filter((row) => row.ghost.touched && row.pose).map(
      ({ name, pose }) => ({ object: name, x: pose.x, y: pose.y, angle: pose.angle }));
    say({ do: "drafts", goals });
  }

  // Show the goals that the node has, unless the operator is placing one here.
  take(drafts) {
    const rows = [...this.rows()];
    if (drafts === null) {  // the node was started after these goals were placed
      if (rows.some((row) => row.ghost.touched) && performance.now() - this.changedAt > DRAFT_QUIET_MS) this.changed();
      return;
    }
    const busy = performance.now() - this.changedAt < DRAFT_QUIET_MS || editing();
    if (!state.placeable || busy || rows.some((row) => row.ghost.hold)) return;
    const key = JSON.stringify(drafts);
    if (key === this.known) return;
    this.known = key;
    const goals = new Map(drafts.map(([name, ...pose]) => [name, pose]));
    for (const row of rows) {
      const goal = goals.get(row.name);
      if (goal && row.ghost.touched && row.pose && isRounded(row.pose, goal)) continue;
      row.ghost.touched = Boolean(goal);
      if (goal) row.ghost.place(...goal);
    }
    followed = "";
    arrangement.refresh();
  }
}

// Whether a goal is this page's own, which the node returns rounded. What was typed stays then.
const isRounded = (pose, goal) =>
  [pose.x, pose.y, pose.angle].every((value, index) => Math.abs(value - goal[index]) < 0.01);
