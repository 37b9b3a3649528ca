//! The server's events, by one stream for all tabs of a browser.
//!
//! The tab that holds a lock reads the stream and tells the others. Without locks (a page over plain HTTP from another machine), each
//! tab only asks at its own pace.

const NAME = "stride-events";
/** Milliseconds until a stream that the server has refused is asked for again. */
const PATIENCE = 5000;

/** @param {(row: HistoryRow | null) => void} heard Gets each row, and `null` if rows are missing. @returns {() => void} ends it */
export function listen(heard) {
  if (!navigator.locks || typeof BroadcastChannel === "undefined") return () => {};
  const channel = new BroadcastChannel(NAME);
  const ends = new AbortController();
  channel.onmessage = ({ data }) => heard(data);
  const tell = (/** @type {HistoryRow | null} */ row) => {
    heard(row);
    channel.postMessage(row);
  };
  navigator.locks.request(NAME, { signal: ends.signal }, () => stream(ends.signal, tell)).catch(() => {});
  return () => {
    ends.abort();
    channel.close();
  };
}

/** Reads the stream until `signal`. @param {AbortSignal} signal @param {(row: HistoryRow | null) => void} tell @returns {Promise<void>} */
function stream(signal, tell) {
  return new Promise((done) => {
    /** @type {EventSource | undefined} */
    let source;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    let again;
    const open = () => {
      source = new EventSource("/v1/events");
      source.addEventListener("history", (event) => tell(JSON.parse(event.data)));
      source.addEventListener("resync", () => tell(null));
      source.onerror = () => {
        // A connection that broke is made again by the browser, from where it was; an answer that was refused is not.
        if (source?.readyState === EventSource.CLOSED) again = setTimeout(open, PATIENCE);
      };
    };
    signal.addEventListener("abort", () => {
      clearTimeout(again);
      source?.close();
      done();
    });
    if (signal.aborted) done();
    else open();
  });
}
