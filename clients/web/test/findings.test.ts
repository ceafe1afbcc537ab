import { create } from "@bufbuild/protobuf";
import { beforeEach, describe, expect, it } from "vitest";

import { FindingCode, type Finding as Message } from "../src/generated/tensormass/v1/finding_pb";
import { SceneStatusSchema } from "../src/generated/tensormass/v1/stream_pb";
import { badgeText } from "../src/hud";
import { Findings, REWORD_MS, STAY_MS } from "../src/stream/findings";

type Fields = Partial<Pick<Message, "code" | "body" | "message" | "accepted">>;

const status = (...findings: Fields[]) => create(SceneStatusSchema, { findings });
const slow = (seconds: string): Fields => ({ code: FindingCode.BUDGET_EXCEEDED, message: `steps take ${seconds} s` });
const inverted: Fields = { code: FindingCode.INVERTED_ELEMENTS, message: "elements are inverted" };

describe("Findings", () => {
  let findings: Findings;
  const messages = () => findings.list().map(({ message }) => message);
  beforeEach(() => {
    findings = new Findings();
  });

  it("keeps a wording for a while although the numbers change", () => {
    findings.update(status(slow("0.02")), 0);
    findings.update(status(slow("0.031")), REWORD_MS - 1);
    expect(messages()).toEqual(["steps take 0.02 s"]);
    findings.update(status(slow("0.04")), REWORD_MS);
    expect(messages()).toEqual(["steps take 0.04 s"]);
  });

  it("keeps a finding that comes and goes, in its place, until it stays away", () => {
    findings.update(status(slow("0.02"), inverted), 0);
    findings.update(status(inverted), STAY_MS);
    expect(messages()).toEqual(["steps take 0.02 s", "elements are inverted"]);
    findings.update(status(inverted), STAY_MS + 1);
    expect(messages()).toEqual(["elements are inverted"]);
  });

  it("tells findings of one kind apart by what they concern", () => {
    const locks = (body: string): Fields => ({ code: FindingCode.LOCKING, body, message: `'${body}' locks` });
    findings.update(status(locks("lobe1"), locks("lobe2")), 0);
    expect(messages()).toEqual(["'lobe1' locks", "'lobe2' locks"]);
  });

  it("puts those last that the scene accepts", () => {
    findings.update(status({ ...inverted, accepted: "a test" }, slow("1")), 0);
    expect(messages()).toEqual(["steps take 1 s", "elements are inverted"]);
  });

  it("shows the warnings of a server that knows no findings", () => {
    const old = (...warnings: string[]) => create(SceneStatusSchema, { warnings });
    findings.update(old("body 'lobe1': strain 0.5", "body 'lobe2': strain 0.5"), 0);
    findings.update(old("body 'lobe1': strain 0.6"), 1);
    expect(messages()).toEqual(["body 'lobe1': strain 0.5", "body 'lobe2': strain 0.5"]);
  });
});

it("counts on the badge what the scene does not accept", () => {
  const one = { message: "m", remedy: "r", place: "p", accepted: "" };
  expect([[], [{ ...one, accepted: "so" }]].map(badgeText)).toEqual(["", ""]);
  expect([[one], [one, one, { ...one, accepted: "so" }]].map(badgeText)).toEqual(["1 finding", "2 findings"]);
});
