/* The tapper's logic: protocol and state machine, without a line of hardware in it.
 *
 * The same source runs on the ATmega328P and on the host's tests. The board's file (board_avr.c) calls
 * the functions below and offers the functions of the second part. Protocol version 2: see
 * docs/hardware.md, "The tapper's protocol". Times are in ms and wrap; energies in microjoules.
 */
#ifndef TAPPER_H
#define TAPPER_H

#include <stdbool.h>
#include <stdint.h>

#include "drive.h"

#define TAPPER_VERSION "2.1.0"
#define TAPPER_SILENCE_MS 500u        /* without a valid frame a charged tapper discharges */
#define TAPPER_LONGEST_WINDOW_MS 100u /* a FIRE with a deadline further ahead is refused */
#define TAPPER_PRESS_MS 500u          /* shortest press of the clear button that counts */
#define TAPPER_CLEAR_WINDOW_MS 10000u /* how long a press counts */
#define TAPPER_FORGET_MS 5000u        /* shortest press that forgets the shot numbers used */
#define TAPPER_MAX_TIMEOUT_MS 10000u
#define TAPPER_MAX_JUMP 4294967296ull /* greatest distance of a shot number from the last one */
#define TAPPER_LINE 64
#define TAPPER_REPLY 192

#ifndef TAPPER_MAX_ENERGY_UJ
#define TAPPER_MAX_ENERGY_UJ 1000000ul
#endif
#ifndef TAPPER_SETUP_ENERGY_UJ
#define TAPPER_SETUP_ENERGY_UJ 5000ul /* 0.3 m/s for a striker of 100 g */
#endif

enum tapper_state {
    TAPPER_UNHOMED,     /* where the carriage is, is not known; nothing moves */
    TAPPER_HOMING,
    TAPPER_SAFE,
    TAPPER_CHARGING,
    TAPPER_CHARGED,
    TAPPER_RELEASING,
    TAPPER_DISCHARGING, /* the carriage goes back to its front end */
    TAPPER_STOPPED
};

/* What a press of the clear button was begun for; one that began before is for nothing. */
enum tapper_press { PRESS_FOR_NOTHING, PRESS_TO_CLEAR, PRESS_TO_FORGET };

struct tapper {
    enum tapper_state state;
    uint16_t session;       /* 0: none yet */
    uint16_t sequence;
    bool has_sequence;
    bool setup;             /* set-up mode: little energy unless the enabling switch is held */
    uint64_t shot;          /* charged or charged last, in earlier boots too: the greatest used */
    uint64_t fired;         /* last fired in this boot; 0: none */
    uint8_t channel;        /* of that shot */
    uint32_t energy_uj;
    uint32_t speed_um_s;    /* of the last shot; 0: not measured */
    uint32_t boot;
    uint32_t heard_at;
    uint32_t charged_at;
    uint32_t timeout_ms;
    bool button;            /* as seen last */
    enum tapper_press press;
    uint32_t pressed_at;
    bool acknowledged;      /* a person pressed the clear button after the stop */
    uint32_t acknowledged_at;
    char line[TAPPER_LINE + 1];
    uint8_t length;
    bool inside;
    char last_body[TAPPER_LINE + 1];
    char last_reply[TAPPER_REPLY];
};

enum tapper_release {
    RELEASE_BEGUN,
    RELEASE_STOPPED, /* a stop or the interlock came first */
    RELEASE_LATE     /* the deadline has passed, or is too far ahead */
};

/* `used`: the greatest shot number charged in earlier boots. */
void tapper_start(struct tapper *t, uint32_t boot, uint64_t used, uint32_t now);
/* One byte from the host, but never the stop byte: that one is for tapper_stop. */
void tapper_byte(struct tapper *t, uint8_t byte, uint32_t now);
/* Call at least every few ms: silence, time-outs, interlock, ends of movements and of the release. */
void tapper_poll(struct tapper *t, uint32_t now);
/* The stop byte, or, `by_wire`, the stop input: that one has cut the motor's power too. */
void tapper_stop(struct tapper *t, bool by_wire);
/* The clear button at the cell, as it is now; call as often as tapper_poll. */
void tapper_button(struct tapper *t, bool pressed, uint32_t now);
/* The speed gate saw the striker. */
void tapper_measured(struct tapper *t, uint32_t speed_um_s);
uint16_t tapper_crc(const char *data, uint8_t length);
/* Whether a FIRE with this deadline may act now. */
bool tapper_in_window(uint32_t deadline, uint32_t now);

/* What the board must offer. */
bool board_interlock_closed(void);
bool board_enabled(void);              /* the enabling switch is held */
bool board_can_store(uint32_t energy_uj);
void board_home(void);                 /* begin to look for the front switch */
uint8_t board_channels(void);          /* tappers on this board */
uint8_t board_at_mounts(void);         /* mask of the channels whose striker closes the switch at its
                                          mount; 0 where no switches are fitted */
void board_charge(uint32_t energy_uj, uint8_t channel); /* begin to charge */
void board_discharge(void);            /* begin to let the energy go without a release; the release
                                          output is off; nothing moves while the place is unknown */
void board_halt(void);                 /* motor and release off at once; the place is unknown then */
enum drive_status board_drive(void);   /* how far the last of these has come */
enum tapper_release board_release(uint32_t deadline); /* one pulse, begun before the deadline,
                                          bounded by a timer whatever the main loop does */
bool board_releasing(void);
void board_keep_used(uint64_t shot);   /* survives a loss of power */
uint32_t board_forget_used(void);      /* forgets it, and counts a new boot, which it returns */
void board_send(const char *text);

#endif
