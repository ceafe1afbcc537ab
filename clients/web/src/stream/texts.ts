// The text messages of the WebSocket, as gateway.proto describes them: `type` names a field of GatewayMessage or
// ViewerMessage, and the other keys are its message in protobuf's JSON mapping.
import { create, fromJson, toJson, type JsonObject, type MessageInitShape } from "@bufbuild/protobuf";

import {
  GatewayMessageSchema,
  ViewerMessageSchema,
  type GatewayMessage,
  type ViewerCommandSchema,
} from "../generated/tensormass/v1/gateway_pb";

/** A message of the gateway: `case` is its type, `value` its fields. */
export type Received = Exclude<GatewayMessage["message"], { case: undefined }>;

/** A message of the viewer: `case` is its type, `value` the fields to send. */
export type Sent = Exclude<MessageInitShape<typeof ViewerMessageSchema>["message"], undefined | { case: undefined }>;

/** A command without its number. */
export type Command = Omit<Exclude<MessageInitShape<typeof ViewerCommandSchema>, { $typeName: string }>, "id"> & {
  readonly action: string;
  readonly scene: string;
};

/** Parses a text message of the gateway. null if it is not one. Passes over fields that this viewer does not know. */
export function parseText(text: string): Received | null {
  try {
    const { type, ...fields } = JSON.parse(text) as JsonObject;
    const kind = typeof type === "string" ? type : "";
    const { message } = fromJson(GatewayMessageSchema, { [kind]: fields }, { ignoreUnknownFields: true });
    return message.case === undefined ? null : message;
  } catch {
    return null;
  }
}

/** Writes a text message to the gateway. Fields without a value are left out, where the schema tells them from zero. */
export function writeText(message: Sent): string {
  const whole = create(ViewerMessageSchema, { message });
  const json = toJson(ViewerMessageSchema, whole, { useProtoFieldName: true, alwaysEmitImplicit: true }) as JsonObject;
  return JSON.stringify({ type: message.case, ...(json[message.case] as JsonObject) });
}
