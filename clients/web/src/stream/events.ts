// What happened in a scene (event.proto). Each message has the last 64 events.
import { fromBinary } from "@bufbuild/protobuf";

import { SceneEventsSchema, SceneEvent_Kind as Kind, type SceneEvent, type SceneEvents } from "../generated/tensormass/v1/event_pb";
import { parse } from "./decode";

export type { SceneEvent, SceneEvents };

/** Events that a tooltip lists. */
const LISTED = 10;

export function decodeEvents(payload: Uint8Array): SceneEvents {
  return parse("events", () => fromBinary(SceneEventsSchema, payload));
}

/** An event in a word or two. */
export function eventLabel({ kind }: Pick<SceneEvent, "kind">): string {
  switch (kind) {
    case Kind.ABLATED:
      return "burnt";
    case Kind.PIECE_FREE:
      return "piece free";
    case Kind.SEVERED:
      return "severed";
    case Kind.BROKEN:
      return "broken";
    case Kind.ADJUSTED:
      return "adjusted";
    case Kind.RESET:
      return "reset";
    case Kind.RESTORED:
      return "restored";
    case Kind.GUARD:
      return "stopped";
    case Kind.HELD:
      return "recovery";
    case Kind.CUT:
      return "cut";
    case Kind.CUT_BEGUN:
      return "cut begins";
    case Kind.CUT_ENDED:
      return "cut ends";
    case Kind.TOOL_ADDED:
      return "tool added";
    case Kind.TOOL_REMOVED:
      return "tool removed";
    case Kind.ATTACHMENT_ADDED:
      return "attached";
    case Kind.ATTACHMENT_REMOVED:
      return "detached";
    default:
      return "event";
  }
}

/** The last events, newest first, a line each. */
export function eventList(events: readonly SceneEvent[]): string {
  return events
    .slice(-LISTED)
    .reverse()
    .map(({ step, text }) => `Step ${step}: ${text}`)
    .join("\n");
}
