/* Strikers at fixed mounts: what the switch at each mount proves. Without a line of hardware in it.
 *
 * A switch is closed while its striker is back at its mount. Nothing is proven after a start: HOME looks
 * whether every switch is closed. After a release the striker must be seen to leave its switch and to
 * come back; else it is blocked, or the switch is stuck, and nothing is charged before HOME.
 */
#ifndef STRIKERS_H
#define STRIKERS_H

#include <stdbool.h>
#include <stdint.h>

#include "drive.h"

#ifndef STRIKER_LEAVE_MS
#define STRIKER_LEAVE_MS 200u   /* from the release to an open switch */
#endif
#ifndef STRIKER_RETURN_MS
#define STRIKER_RETURN_MS 4000u /* from the release to a closed switch: the slowest stroke and back */
#endif
#define STRIKER_SETTLE_MS 3u    /* equal samples of the switches that count */

enum strikers_phase { STRIKERS_LOST, STRIKERS_AT_MOUNTS, STRIKERS_LEAVING, STRIKERS_AWAY };

struct strikers {
    enum strikers_phase phase;
    uint8_t fitted;   /* mask of the channels */
    uint8_t home;     /* mask: settled samples of the switches */
    uint8_t sample;
    uint8_t equal;    /* samples in a row that were the same, at most STRIKER_SETTLE_MS */
    uint8_t channel;  /* released last */
    uint16_t passed;  /* ms since the release */
};

void strikers_start(struct strikers *s, uint8_t count);
void strikers_prove(struct strikers *s);                    /* HOME: are all at their mounts? */
void strikers_released(struct strikers *s, uint8_t channel);
/* Call every millisecond with the switches as they are, one bit a channel. */
void strikers_tick(struct strikers *s, uint8_t closed);
enum drive_status strikers_status(const struct strikers *s);

#endif
