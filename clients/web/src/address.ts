// The page's address: what it asks for, and what it remembers for a reload.
//
// ?code= as the gateway prints it, or ?token=: enter() changes them into a cookie and leaves them out; ?scene= names the
// selected scene (default: the first that runs); ?grid=1 shows all scenes in a grid; ?quality= fixes a level of
// view/quality.ts or is "automatic" (default: what Display remembers); ?codec= (default: q16), ?rate_hz=, ?normals= and
// ?detail= choose the frames that the gateway sends (docs/protocol.md).
import type { Diagnosis, FrameChoice } from "./stream/connection";

export class Address {
  readonly #url: URL;

  constructor(href: string) {
    this.#url = new URL(href);
  }

  get quality(): string | null {
    return this.#url.searchParams.get("quality");
  }

  get scene(): string | null {
    return this.#url.searchParams.get("scene");
  }

  get grid(): boolean {
    return this.#url.searchParams.get("grid") === "1";
  }

  /** Returns the address without a quality, after another one was chosen in the page. */
  withoutQuality(): string {
    set(this.#url.searchParams, "quality", null);
    return this.#url.href;
  }

  /** The frames of a level of quality. What the address itself chooses stays. */
  framesOf({ detail, rateHz }: { readonly detail: number; readonly rateHz: number | null }): FrameChoice {
    const given = this.#url.searchParams;
    return { ...(given.has("detail") ? {} : { detail }), ...(given.has("rate_hz") ? {} : { rate_hz: rateHz }) };
  }

  /**
   * Changes the code or the token of the address into a cookie, which no script can read. Returns the address without
   * them; null: there was none, or the gateway does not take it, which `diagnose` explains.
   */
  async enter(): Promise<string | null> {
    const { searchParams } = this.#url;
    const given = Object.fromEntries(["code", "token"].map((name) => [name, searchParams.get(name) ?? ""]));
    if (given["code"] === "" && given["token"] === "") {
      return null;
    }
    try {
      const body = JSON.stringify(given);
      const reply = await fetch(`//${this.#url.host}/enter`, { method: "POST", body });
      if (!reply.ok && given["code"] === "") {
        return null;
      }
    } catch {
      return null;
    }
    set(searchParams, "code", null);
    set(searchParams, "token", null);
    return this.#url.href;
  }

  /** Address of the WebSocket, with the choice of frames. The gateway refuses an unknown choice in words. */
  get stream(): string {
    return `${this.#url.protocol === "https:" ? "wss:" : "ws:"}${this.#streamPath}`;
  }

  /** Returns the address with another choice of scene and grid. */
  with(scene: string | null, grid: boolean): string {
    const { searchParams } = this.#url;
    set(searchParams, "scene", scene);
    set(searchParams, "grid", grid ? "1" : null);
    return this.#url.href;
  }

  /** Asks the gateway by POST why a connection failed. A browser hides the reason of a refused WebSocket from its page. */
  async diagnose(): Promise<Diagnosis> {
    try {
      const reply = await fetch(this.#streamPath, { method: "POST" });
      if (reply.ok) {
        return { reason: "the gateway answers, but no WebSocket gets through to it", final: false };
      }
      return { reason: await reply.text(), final: reply.status === 403 || reply.status === 400 };
    } catch {
      return { reason: "the gateway does not answer", final: false };
    }
  }

  get #streamPath(): string {
    const given = this.#url.searchParams;
    const token = given.get("token");
    const query = new URLSearchParams({ ...(token === null ? {} : { token }), codec: "q16" });
    for (const name of ["codec", "rate_hz", "normals", "detail"]) {
      const value = given.get(name);
      if (value !== null) {
        query.set(name, value);
      }
    }
    return `//${this.#url.host}/stream?${query.toString()}`;
  }
}

function set(parameters: URLSearchParams, name: string, value: string | null): void {
  if (value === null) {
    parameters.delete(name);
  } else {
    parameters.set(name, value);
  }
}
