"use strict";
// STOP. It has a port of its own, which is received whatever else the page's node has to do; the page's
// own connection is the second way.

const STOP_CHECK_MS = 2000;     // between checks that a stop would be received
const STOP_PATIENCE_MS = 3000;

class Stop {
  constructor(alsoSay, onAnswer, onChange) {
    this.alsoSay = alsoSay;     // sends it over the page's connection; false where there is none
    this.onAnswer = onAnswer;   // is told how it went: text, "good" or "bad"
    this.onChange = onChange;   // is told when `served` changes
    this.served = false;
    this.url = "";
    this.check();
  }

  async ask(what) {
    if (!this.url) {
      const port = await (await fetch("stop-port", { cache: "no-store" })).text();
      this.url = `${location.protocol}//${location.hostname}:${port}/`;
    }
    const token = sessionStorage.getItem("token") || "";
    const answer = await fetch(this.url, {
      method: "POST", body: JSON.stringify({ do: what, token }), signal: AbortSignal.timeout(STOP_PATIENCE_MS),
    });
    if (!answer.ok) throw new Error(await answer.text());
  }

  async check() {
    const before = this.served;
    try {
      await this.ask("check");
      this.served = true;
    } catch (error) {
      this.served = false;
      this.url = "";  // a node that was started again may serve it elsewhere
    }
    if (this.served !== before) this.onChange();
    setTimeout(() => this.check(), STOP_CHECK_MS);
  }

  async press() {
    const said = this.alsoSay();
    try {
      await this.ask("stop");
      this.onAnswer("STOP sent to arm, tapper and planner", "good");
    } catch (error) {
      if (!said) this.onAnswer("STOP was NOT sent: use the wired emergency stop", "bad");
    }
  }
}
