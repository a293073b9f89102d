/** The card that shows how far loading is, and cancels it. */

import { byId } from "./dom.js";
import { bytes } from "./format.js";

/**
 * One thing is loaded at a time: whatever begins ends what went on before.
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
    let most = 0; // a share that goes back is believed by nobody
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
        if (share) bar.value = most = Math.max(most, Math.min(1, share));
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
