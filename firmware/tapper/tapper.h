/* The tapper's logic: protocol and state machine, independent of the hardware.
 *
 * The same source runs on the ATmega328P and in the tests on the host. The board's file
 * (board_avr.c) calls the functions of the first part below and implements those of the second
 * part. Protocol version 2: see docs/hardware.md, "The tapper's protocol". Times are in ms and
 * wrap; energies are in microjoules.
 */
#ifndef TAPPER_H
#define TAPPER_H

#include <stdbool.h>
#include <stdint.h>

#include "drive.h"

#define TAPPER_VERSION "2.1.0"
#define TAPPER_SILENCE_MS 500u        /* time without messages after which a tapper discharges */
#define TAPPER_LONGEST_WINDOW_MS 100u /* a FIRE with a later deadline is refused */
#define TAPPER_PRESS_MS 500u          /* shortest valid press of the clear button */
#define TAPPER_CLEAR_WINDOW_MS 10000u /* time for which a press is valid */
#define TAPPER_FORGET_MS 5000u        /* shortest press that clears the used shot numbers */
#define TAPPER_MAX_TIMEOUT_MS 10000u
#define TAPPER_MAX_JUMP 4294967296ull /* maximum increase of the shot number */
#define TAPPER_LINE 64
#define TAPPER_REPLY 192

#ifndef TAPPER_MAX_ENERGY_UJ
#define TAPPER_MAX_ENERGY_UJ 1000000ul
#endif
#ifndef TAPPER_SETUP_ENERGY_UJ
#define TAPPER_SETUP_ENERGY_UJ 5000ul /* 0.3 m/s for a striker of 100 g */
#endif

enum tapper_state {
    TAPPER_UNHOMED,     /* the position is unknown; nothing moves */
    TAPPER_HOMING,
    TAPPER_SAFE,
    TAPPER_CHARGING,
    TAPPER_CHARGED,
    TAPPER_RELEASING,
    TAPPER_DISCHARGING, /* the carriage returns to its front end */
    TAPPER_STOPPED
};

/* Effect of a press of the clear button; none if the press began before a stop or a charge. */
enum tapper_press { PRESS_FOR_NOTHING, PRESS_TO_CLEAR, PRESS_TO_FORGET };

struct tapper {
    enum tapper_state state;
    uint16_t session;       /* 0: no session yet */
    uint16_t sequence;
    bool has_sequence;
    bool setup;             /* set-up mode: limited energy unless the enabling switch is held */
    uint64_t shot;          /* shot charged last, even before a reset; the greatest number used */
    uint64_t fired;         /* shot fired last in this boot; 0: none */
    uint8_t channel;        /* channel of `shot` */
    uint32_t energy_uj;
    uint32_t speed_um_s;    /* measured speed of the last shot; 0: not measured */
    uint32_t boot;
    uint32_t heard_at;
    uint32_t charged_at;
    uint32_t timeout_ms;
    bool button;            /* state of the clear button at the last call */
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
    RELEASE_STOPPED, /* prevented by a stop or the interlock */
    RELEASE_LATE     /* the deadline has passed or is too late */
};

/* Initialise; `used` is the greatest shot number charged in earlier boots. */
void tapper_start(struct tapper *t, uint32_t boot, uint64_t used, uint32_t now);
/* Process one byte from the host, except the stop byte, for which tapper_stop is called. */
void tapper_byte(struct tapper *t, uint8_t byte, uint32_t now);
/* Check silence, timeouts, interlock, and the end of motions and release; call every few ms. */
void tapper_poll(struct tapper *t, uint32_t now);
/* Stop on the stop byte or, if `by_wire`, on the stop input, which also cuts the motor's power. */
void tapper_stop(struct tapper *t, bool by_wire);
/* Process the current state of the clear button at the cell; call as often as tapper_poll. */
void tapper_button(struct tapper *t, bool pressed, uint32_t now);
/* Store the striker's speed measured by the speed gate. */
void tapper_measured(struct tapper *t, uint32_t speed_um_s);
uint16_t tapper_crc(const char *data, uint8_t length);
/* Return whether a FIRE with this deadline may be executed now. */
bool tapper_in_window(uint32_t deadline, uint32_t now);

/* Functions that the board must implement. */
bool board_interlock_closed(void);
bool board_enabled(void);              /* the enabling switch is held */
bool board_can_store(uint32_t energy_uj);
void board_home(void);                 /* start homing to the front switch */
uint8_t board_channels(void);          /* number of tappers on this board */
uint8_t board_at_mounts(void);         /* mask of the channels whose striker closes the switch at
                                          its mount; 0 if no switches are fitted */
void board_charge(uint32_t energy_uj, uint8_t channel); /* start charging */
void board_discharge(void);            /* start discharging without a release; the release output
                                          is off; nothing moves while the position is unknown */
void board_halt(void);                 /* motor and release off; the position is then unknown */
enum drive_status board_drive(void);   /* status of the last of these actions */
enum tapper_release board_release(uint32_t deadline); /* one pulse that begins before the
                                          deadline; a timer limits its length */
bool board_releasing(void);
void board_keep_used(uint64_t shot);   /* store; survives a loss of power */
uint32_t board_forget_used(void);      /* clear the stored number; return the new boot number */
void board_send(const char *text);

#endif
