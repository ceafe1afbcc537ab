// Writes src/generated/ from the protocol files: the messages that the viewer decodes.
import { execFileSync } from "node:child_process";
import { mkdirSync, rmSync } from "node:fs";
import { delimiter, join } from "node:path";

const here = import.meta.dirname;
const out = join(here, "src", "generated");
rmSync(out, { recursive: true, force: true });
mkdirSync(out, { recursive: true });
try {
  execFileSync(
    process.env.PROTOC ?? "protoc",
    [
      `--proto_path=${join(here, "..", "..", "proto")}`,
      `--es_out=${out}`,
      "--es_opt=target=ts,import_extension=none",
      "tensormass/v1/adjustment.proto",
      "tensormass/v1/changes.proto",
      "tensormass/v1/edit.proto",
      "tensormass/v1/event.proto",
      "tensormass/v1/finding.proto",
      "tensormass/v1/guard.proto",
      "tensormass/v1/solver.proto",
      "tensormass/v1/scene.proto",
      "tensormass/v1/stream.proto",
      "tensormass/v1/gateway.proto",
    ],
    {
      stdio: "inherit",
      env: { ...process.env, PATH: [join(here, "node_modules", ".bin"), process.env.PATH].join(delimiter) },
    },
  );
} catch (error) {
  console.error(
    `generate: protoc failed (${error.message}). Install it (Debian: protobuf-compiler) or name it in $PROTOC.`,
  );
  process.exit(1);
}
