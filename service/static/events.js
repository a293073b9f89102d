/** Server-sent events with `fetch`, which unlike EventSource can send a key and distinguishes errors from lost connections. */

/** @typedef {{id: string, event: string, data: string}} Message */

/**
 * Yield the messages of a stream until it ends.
 * @param {ReadableStream<BufferSource>} body
 * @returns {AsyncGenerator<Message>}
 */
export async function* messages(body) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  try {
    for (;;) {
      const { value, done } = await reader.read();
      if (done) return; // an incomplete message in `rest` is discarded
      const blocks = (rest + value).replaceAll("\r\n", "\n").split("\n\n");
      rest = blocks.pop() ?? "";
      for (const block of blocks) {
        const message = parse(block);
        if (message) yield message;
      }
    }
  } finally {
    reader.cancel().catch(() => {}); // closes the connection
  }
}

/**
 * @param {string} block
 * @returns {Message | null} null for comments and fields without data
 */
function parse(block) {
  const message = { id: "", event: "message", data: "" };
  /** @type {string[]} */
  const data = [];
  for (const line of block.split("\n")) {
    const [, field, value] = line.match(/^([^:]*):? ?(.*)$/) ?? [];
    if (field === "data") data.push(value);
    else if (field === "id" || field === "event") message[field] = value;
  }
  message.data = data.join("\n");
  return data.length > 0 ? message : null;
}
