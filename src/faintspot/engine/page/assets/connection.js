// The web socket: receives messages, sends requests, reconnects automatically.

import { unpacked } from "./message.js";

const KEY = `faintspot-token-${location.port}`;
const AGAIN_MS = 1000;

/** Return the token from the address, and remove it from the address bar and history. */
function tokenOfAddress() {
  if (location.hash.length > 1) {
    sessionStorage.setItem(KEY, decodeURIComponent(location.hash.slice(1)));
    history.replaceState(null, "", location.pathname);
  }
  return sessionStorage.getItem(KEY) || "";
}

export class Connection {
  /** Call onMessage(message), onAccess({ok, may_change, error}) and onLost(). */
  constructor(handlers) {
    this.handlers = handlers;
    this.token = tokenOfAddress();
    this.waiting = new Map();
    this.number = 0;
    addEventListener("hashchange", () => { this.token = tokenOfAddress(); this.hello(); });
    this.open();
  }

  open() {
    this.socket = new WebSocket(`ws://${location.host}/stream`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => this.hello();
    this.socket.onmessage = ({ data }) => {
      if (typeof data !== "string") return this.handlers.onMessage(unpacked(data));
      const reply = JSON.parse(data);
      this.waiting.get(reply.id)?.(reply);
      this.waiting.delete(reply.id);
    };
    this.socket.onclose = () => {
      for (const answer of this.waiting.values()) answer({ ok: false, error: "the connection was lost" });
      this.waiting.clear();
      this.handlers.onLost();
      setTimeout(() => this.open(), AGAIN_MS);
    };
  }

  /** Identify this client. */
  async hello() {
    const reply = await this.ask("hello", { token: this.token });
    const isRefused = !reply.ok && this.socket.readyState === WebSocket.OPEN;  // not merely lost
    if (isRefused && this.token) sessionStorage.removeItem(KEY);
    this.handlers.onAccess(reply);
    return reply;
  }

  async unlock(token) {
    this.token = token.trim();
    sessionStorage.setItem(KEY, this.token);
    return this.hello();
  }

  /** Send a request; the answer is {ok, ...} or {ok: false, error}. */
  ask(what, fields = {}) {
    if (this.socket.readyState !== WebSocket.OPEN) return Promise.resolve({ ok: false, error: "not connected" });
    const id = ++this.number;
    this.socket.send(JSON.stringify({ ...fields, id, do: what }));
    return new Promise((answer) => this.waiting.set(id, answer));
  }
}
