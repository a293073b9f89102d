/** The files of single scenes that Spark reads: all other files are containers, which this project decodes. */

/** @typedef {"ply" | "spz" | "splat" | "ksplat"} FileType */

/** Types by Spark's names of them, which are the endings too. @type {FileType[]} */
const FILE_TYPES = ["ply", "spz", "splat", "ksplat"];

/** Endings for the choice of a file. */
export const FILE_ENDINGS = FILE_TYPES.map((type) => `.${type}`).join();

/** Return the type of a file by its name; of a container, none. @param {string} name */
export const fileTypeOf = (name) => FILE_TYPES.find((type) => name.toLowerCase().endsWith(`.${type}`));

/** Return the type of a format by the service's name of it; of a container, none. @param {string} format */
export const fileTypeOfFormat = (format) => FILE_TYPES.find((type) => type === format);

/** Whether y points up and z back in files of this type, as in three.js, not down and ahead. @param {FileType} type */
export const pointsUp = (type) => type === "spz";
