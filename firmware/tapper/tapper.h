/* The tapper's logic: protocol and state machine, without a line of hardware in it.
 *
 * The same source runs on the ATmega328P and on the host's tests. The board's file (board_avr.c) calls
 * the functions below and offers the functions of the second part. Protocol version 1: see
 * docs/hardware.md, "The tapper's protocol". Times are in ms and wrap; energies in microjoules.
 */
#ifndef TAPPER_H
#define TAPPER_H

#include <stdbool.h>
#include <stdint.h>

#define TAPPER_VERSION "1.0.0"
#define TAPPER_SILENCE_MS 500u       /* without a valid frame a drawn tapper disarms */
#define TAPPER_CLEAR_WINDOW_MS 10000u /* how long a press of the clear button counts */
#define TAPPER_MAX_TIMEOUT_MS 10000u
#define TAPPER_LINE 64
#define TAPPER_REPLY 160

#ifndef TAPPER_MAX_ENERGY_UJ
#define TAPPER_MAX_ENERGY_UJ 1000000ul
#endif

enum tapper_state {
    TAPPER_SAFE,
    TAPPER_DRAWING,
    TAPPER_DRAWN,
    TAPPER_RELEASING,
    TAPPER_STOPPED
};

struct tapper {
    enum tapper_state state;
    uint16_t session;       /* 0: none yet */
    uint16_t sequence;
    bool has_sequence;
    uint64_t shot;          /* drawn or drawn last */
    uint64_t fired;         /* last fired in this boot; 0: none */
    uint64_t used;          /* greatest shot drawn in an earlier boot */
    uint32_t energy_uj;
    uint32_t speed_um_s;    /* of the last shot; 0: not measured */
    uint32_t boot;
    uint32_t heard_at;
    uint32_t armed_at;
    uint32_t timeout_ms;
    uint32_t pressed_at;
    bool pressed;
    char line[TAPPER_LINE + 1];
    uint8_t length;
    bool inside;
    char last_body[TAPPER_LINE + 1];
    char last_reply[TAPPER_REPLY];
};

void tapper_start(struct tapper *t, uint32_t boot, uint64_t used, uint32_t now);
/* One byte from the host, but never the stop byte: that one is for tapper_stop. */
void tapper_byte(struct tapper *t, uint8_t byte, uint32_t now);
/* Call at least every few ms: silence, time-outs, interlock, ends of draw and release. */
void tapper_poll(struct tapper *t, uint32_t now);
/* The stop byte or the stop input. */
void tapper_stop(struct tapper *t);
/* The clear button at the cell. */
void tapper_press_clear(struct tapper *t, uint32_t now);
/* The speed gate saw the striker. */
void tapper_measured(struct tapper *t, uint32_t speed_um_s);
uint16_t tapper_crc(const char *data, uint8_t length);

/* What the board must offer. */
bool board_interlock_closed(void);
bool board_can_store(uint32_t energy_uj);
void board_draw(uint32_t energy_uj);   /* begin to draw or charge */
bool board_drawn(void);
void board_relax(void);                /* let the energy go without a release */
bool board_release(void);              /* one pulse, bounded by a timer whatever the main loop does;
                                          false if a stop came first: then nothing was released */
bool board_releasing(void);
void board_keep_used(uint64_t shot);   /* survives a loss of power */
void board_send(const char *text);

#endif
