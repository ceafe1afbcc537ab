// The words for what the pointer does with a tool, and for whose tool it is.

/** What the pointer does with tools: nothing, it is over one, or it drags one. */
export type Hand = "away" | "over" | "holds";

/**
 * Returns the hint for a hand; null: the pointer has nothing to do with tools.
 *
 * @param claimedBy The client that claims the tool below the pointer; null: none does.
 */
export function hintOf(hand: Hand, claimedBy: bigint | null): string | null {
  if (hand === "away") {
    return null;
  }
  if (claimedBy === null) {
    return hand === "over" ? "Drag to move this tool" : "The tool follows the pointer";
  }
  // As the daemon's messages write it.
  const client = `client 0x${claimedBy.toString(16)}`;
  return hand === "over" ? `This tool is in the hand of ${client} · drag to take it over` : `Taking this tool over from ${client}`;
}
