"use strict";
// STOP is sent to a dedicated port, which responds even if the page's node is busy, and also over
// the page's own connection.

const STOP_CHECK_MS = 2000;     // time between two checks that a stop would be received
const STOP_PATIENCE_MS = 3000;

class Stop {
  constructor(alsoSay, onAnswer, onChange) {
    this.alsoSay = alsoSay;     // sends the stop over the page's connection; false if it is lost
    this.onAnswer = onAnswer;   // called with the result: text, "good" or "bad"
    this.onChange = onChange;   // called when `served` changes
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
      this.url = "";  // a restarted node may use another port
    }
    if (this.served !== before) this.onChange();
    setTimeout(() => this.check(), STOP_CHECK_MS);
  }

  async press() {
    const said = this.alsoSay();
    try {
      await this.ask("stop");
      this.onAnswer("STOP sent to all devices and the planner", "good");
    } catch (error) {
      if (!said) this.onAnswer("STOP was NOT sent: use the wired emergency stop", "bad");
    }
  }
}
