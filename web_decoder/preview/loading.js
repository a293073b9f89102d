/** The card that shows the progress of loading, with a button to cancel it. */

import { byId } from "./dom.js";
import { bytes } from "./format.js";

/**
 * Return a loader of one thing at a time: a new load cancels the former one.
 * @returns {{begin: (what: string) => Load, cancel: () => void}}
 */
export function loader() {
  /** @type {AbortController | null} */
  let current = null;
  const [card, bar, amount] = [byId("loading"), byId("loading-bar"), byId("loading-amount")];
  const cancel = () => current?.abort(new DOMException("cancelled", "AbortError"));
  byId("cancel").addEventListener("click", cancel);

  /** @param {string} what */
  function begin(what) {
    cancel();
    const own = (current = new AbortController());
    let largest = 0; // the bar never goes back
    byId("loading-what").textContent = what;
    amount.textContent = "";
    bar.removeAttribute("value");
    card.hidden = false;
    return {
      signal: own.signal,
      /** @type {Load["progress"]} */
      progress({ received, total, decoded = 0, planes }) {
        if (current !== own) return;
        const [ofAll, ofImages] = [received / total, planes ? decoded / planes : 0];
        const share = total && planes ? (ofAll + ofImages) / 2 : total ? ofAll : ofImages;
        if (share) bar.value = largest = Math.max(largest, Math.min(1, share));
        const ofBytes = received < total ? `${bytes(received)} of ${bytes(total)}` : received ? bytes(received) : null;
        const ofPlanes = planes ? `${decoded} of ${planes} planes` : null;
        amount.textContent = [ofBytes, ofPlanes].filter((text) => text !== null).join(" · ");
      },
      done() {
        if (current !== own) return;
        current = null;
        card.hidden = true;
      },
    };
  }

  return { begin, cancel };
}

/**
 * @typedef {object} Load
 * @property {AbortSignal} signal
 * @property {(state: {received: number, total: number, decoded?: number, planes?: number}) => void} progress
 * @property {() => void} done
 */
