// Forms for changes, with errors shown beside the fields.

const byId = (id) => document.getElementById(id);

export function element(tag, properties = {}, children = []) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function answer(id, reply) {
  const place = byId(id);
  place.dataset.ok = reply.ok;
  place.textContent = reply.ok ? reply.text || "done" : reply.error;
}

function learntInWords({ found, taken, fault, unix_time_s }) {
  if (!found) return `Not learnt again: ${fault}`;
  const time = new Date(1000 * unix_time_s).toLocaleTimeString("en-GB");
  const outcome = fault ? `refused: ${fault}` : taken ? "taken" : "not taken";
  return `Kalman filter learnt at ${time}: ${found}; ${outcome}`;
}

export class Controls {
  constructor(connection) {
    this.connection = connection;
    this.names = "";
    byId("token-form").addEventListener("submit", (event) => this.unlock(event));
    byId("settings-form").addEventListener("submit", (event) => this.set(event));
    byId("undo").addEventListener("click", () => this.undo());
    byId("settings").addEventListener("input", () => this.settingsEdited());
    byId("explain").addEventListener("change", (event) =>
      byId("settings").classList.toggle("explained", event.currentTarget.checked));
    this.onSubmit("interleave-form", "interleave-answer", "interleave", () => ({
      methods: byId("methods-text").value.trim(), every: Number(byId("every").value) }));
    this.onSubmit("record-form", "record-answer", "record", () => ({ file: byId("file").value.trim() }));
    this.onSubmit("loop-form", "loop-answer", "loop", () => ({ action: "gain", gain: Number(byId("gain").value) }));
    byId("interleave-form").addEventListener("input", () => { this.methodsEdited = true; });
    byId("loop-form").addEventListener("input", () => { this.gainEdited = true; });
    this.onClick("stop-recording", "record-answer", "stop_recording", {});
    this.onClick("loop-open", "loop-answer", "loop", { action: "open" });
    this.onClick("loop-flat", "loop-answer", "loop", { action: "flat" });
    this.onClick("loop-close", "loop-answer", "loop", { action: "close" });
  }

  onSubmit(form, place, what, fields) {
    byId(form).addEventListener("submit", async (event) => {
      event.preventDefault();
      answer(place, { ok: true, text: "…" });
      const reply = await this.connection.ask(what, fields());
      answer(place, reply);
      if (reply.ok) this.methodsEdited = this.gainEdited = false;
    });
  }

  onClick(button, place, what, fields) {
    byId(button).addEventListener("click", async () => answer(place, await this.connection.ask(what, fields)));
  }

  /** Show the forms to clients with the token. */
  access({ ok, may_change: mayChange, error }) {
    byId("controls").hidden = !mayChange;
    byId("token-form").hidden = Boolean(mayChange);
    byId("token-error").textContent = ok ? "" : error;
    byId("token").setAttribute("aria-invalid", String(!ok));
  }

  async unlock(event) {
    event.preventDefault();
    const token = byId("token").value;
    byId("token").value = "";
    await this.connection.unlock(token);
  }

  // Settings ---------------------------------------------------------------------------------------------

  /** Fill in the running settings; keep fields that are being edited. */
  settings(rows) {
    const names = rows.map((row) => row.name + row.choices).join();
    if (names !== this.names) {
      this.names = names;
      byId("settings").replaceChildren(...rows.map((row) => this.field(row)));
    }
    for (const row of rows) {
      const input = byId(`setting-${row.name}`);
      const edited = input.value !== input.dataset.now;
      input.dataset.now = row.value;
      if (!edited) input.value = row.value;
    }
    this.settingsEdited();
  }

  field({ name, value, meaning, allowed, choices }) {
    const id = `setting-${name}`;
    const input = choices.length
      ? element("select", {}, choices.map((choice) => element("option", { value: choice, textContent: choice })))
      : element("input", { autocomplete: "off", spellcheck: false });
    Object.assign(input, { id, name, value });
    input.dataset.now = value;
    input.setAttribute("aria-describedby", `${id}-help ${id}-error`);
    const help = element("p", { className: "soft", id: `${id}-help` }, [
      element("span", { className: "meaning", textContent: `${meaning.replaceAll("`", "")} ` }),
      choices.length ? "" : allowed]);
    const error = element("p", { className: "error", id: `${id}-error` });
    error.setAttribute("role", "alert");
    return element("div", {}, [element("label", { htmlFor: id, textContent: name }), input, error, help]);
  }

  inputs() {
    return [...byId("settings").querySelectorAll("input, select")];
  }

  settingsEdited() {
    let any = false;
    for (const input of this.inputs()) {
      const changed = input.value !== input.dataset.now;
      input.dataset.changed = changed;
      any ||= changed;
    }
    byId("apply").disabled = !any;
  }

  async set(event) {
    event.preventDefault();
    const changed = this.inputs().filter((input) => input.value !== input.dataset.now);
    this.clearErrors();
    byId("apply").disabled = true;
    answer("settings-answer", { ok: true, text: "in preparation" });
    const reply = await this.connection.ask("set", {
      changes: changed.map((input) => `${input.name}=${input.value}`), subapertures: byId("subapertures").value });
    byId("settings-answer").textContent = "";
    if (reply.ok) for (const input of changed) input.dataset.now = input.value;
    this.settingsEdited();
    if (reply.ok) answer("settings-answer", reply);
    else this.showError(reply, changed);
  }

  undo() {
    for (const input of this.inputs()) input.value = input.dataset.now;
    byId("subapertures").value = "";
    this.clearErrors();
    this.settingsEdited();
  }

  clearErrors() {
    for (const place of byId("settings-form").querySelectorAll(".error")) place.textContent = "";
    for (const input of byId("settings-form").querySelectorAll("[aria-invalid]")) input.removeAttribute("aria-invalid");
  }

  /** Show an error beside the field that it names. */
  showError(reply, changed) {
    let named = changed.find((input) => new RegExp(`\\b${input.name}\\b`).test(reply.error));
    let place = named && byId(`${named.id}-error`);
    if (!named && /^(where|sub-aperture)/.test(reply.error)) {
      named = byId("subapertures");
      place = byId("subapertures-answer");
    }
    if (!named) return answer("settings-answer", reply);
    named.setAttribute("aria-invalid", "true");
    place.textContent = reply.error;
    named.focus();
  }

  // State of the engine ---------------------------------------------------------------------------------

  status(status) {
    const { loop, learning, recording, methods } = status;
    const there = Boolean(loop) && loop.state !== "none";
    byId("loop-form").hidden = !there;
    if (there) {
      const again = loop.closed_again_because && `again, it had been opened: ${loop.closed_again_because}`;
      const parts = [loop.state, loop.opened_because, again, loop.obstacle];
      byId("loop-state").textContent = parts.filter(Boolean).join(": ");
      byId("loop-learnt").hidden = !learning;
      byId("loop-learnt").textContent = learning ? learntInWords(learning) : "";
      const gain = byId("gain");
      if (document.activeElement !== gain && !this.gainEdited) gain.value = loop.gain ?? "";
    }
    if (methods && !this.methodsEdited) {
      byId("methods-text").value = methods.join();
      if (methods.length > 1) byId("every").value = status.every;
    }
    if (recording) {
      byId("stop-recording").disabled = !recording.running;
      byId("record").disabled = recording.running;
      if (recording.running) {
        answer("record-answer", { ok: true, text: `${recording.file}: ${recording.frames.toLocaleString("en")} frames` });
      } else if (recording.text || recording.error) {
        answer("record-answer", { ok: !recording.error, text: recording.text, error: recording.error });
      }
    }
  }
}
