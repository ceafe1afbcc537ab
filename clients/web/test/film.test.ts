import { describe, expect, it } from "vitest";

import { Film, MAX_FILM_BYTES, type OpenRecorder, type Recorder, type RecorderEvents } from "../src/panel/film";

/** A recorder that gives its parts when told to. */
class FakeRecorder implements Recorder {
  state: Recorder["state"] = "inactive";

  constructor(
    readonly type: string,
    readonly events: RecorderEvents,
  ) {}

  start(): void {
    this.state = "recording";
  }

  give(data: Blob): void {
    this.events.onPart(data);
  }

  stop(): void {
    this.state = "inactive";
    this.events.onStop();
  }
}

interface Told {
  running: boolean[];
  films: { file: Blob; name: string }[];
  errors: string[];
}

function filmer(supported: string[], open?: OpenRecorder) {
  const told: Told = { running: [], films: [], errors: [] };
  const recorders: FakeRecorder[] = [];
  const film = new Film(
    (type) => supported.includes(type),
    open ??
      ((type, events) => {
        const recorder = new FakeRecorder(type, events);
        recorders.push(recorder);
        return recorder;
      }),
    {
      onRunning: (running) => told.running.push(running),
      onFilm: (file, name) => told.films.push({ file, name }),
      onError: (text) => told.errors.push(text),
    },
  );
  return { film, told, recorders };
}

describe("Film", () => {
  it("starts and ends with the same button, and saves all parts in order", async () => {
    const { film, told, recorders } = filmer(["video/webm"]);
    film.toggle("scene-1s");
    expect(film.running).toBe(true);
    recorders[0]!.give(new Blob(["one "]));
    recorders[0]!.give(new Blob(["two"]));
    film.toggle("scene-9s");
    expect(told.running).toEqual([true, false]);
    expect(told.films.map(({ name }) => name)).toEqual(["scene-1s.webm"]);
    expect(await told.films[0]!.file.text()).toBe("one two");
    expect(told.films[0]!.file.type).toBe("video/webm");
    film.toggle("again");
    expect(recorders.length).toBe(2);
    expect(told.errors).toEqual([]);
  });

  it("takes the best type that the browser knows", () => {
    const { film, recorders } = filmer(["video/webm", "video/webm;codecs=vp9"]);
    film.toggle("a");
    expect(recorders[0]!.type).toBe("video/webm;codecs=vp9");
    const other = filmer(["video/mp4"]);
    other.film.toggle("a");
    other.recorders[0]!.give(new Blob(["x"]));
    other.film.toggle("a");
    expect(other.told.films[0]!.name).toBe("a.mp4");
  });

  it("is not possible where the browser knows no type", () => {
    const { film, told, recorders } = filmer(["video/ogg"]);
    expect(film.possible).toBe(false);
    film.toggle("a");
    expect(recorders).toEqual([]);
    expect(told.running).toEqual([]);
  });

  it("ends by itself before it fills the memory", () => {
    const { film, told, recorders } = filmer(["video/webm"]);
    film.toggle("a");
    const part = new Blob(["x"]);
    Object.defineProperty(part, "size", { value: MAX_FILM_BYTES / 2 });
    recorders[0]!.give(part);
    expect(film.running).toBe(true);
    recorders[0]!.give(part);
    expect(film.running).toBe(false);
    expect(told.films.length).toBe(1);
  });

  it("keeps what it has when the browser fails, and says so", () => {
    const { film, told, recorders } = filmer(["video/webm"]);
    film.toggle("a");
    recorders[0]!.give(new Blob(["x"]));
    recorders[0]!.events.onError();
    recorders[0]!.stop();
    expect(told.films.length).toBe(1);
    expect(told.errors).toEqual(["The browser stopped the film early"]);
    film.toggle("b");
    recorders[1]!.stop();
    expect(told.films.length).toBe(1);
    expect(told.errors[1]).toBe("The browser recorded nothing");
  });

  it("says why a recorder cannot be opened", () => {
    const { film, told } = filmer(["video/webm"], () => {
      throw new Error("no codec");
    });
    film.toggle("a");
    expect(told.errors).toEqual(["No film: no codec"]);
    expect(film.running).toBe(false);
  });
});
