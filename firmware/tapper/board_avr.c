/* The tapper's board: ATmega328P at 16 MHz (such as an Arduino Nano), 115200 baud on its USB port.
 *
 *   PD2  interlock, closed loop to ground, pull-up          (Nano D2)
 *   PD3  stop loop, normally closed to ground, pull-up      (D3)
 *   PB0  clear button to ground, pull-up                    (D8)
 *   PD4  release: latch magnet or striker coil, active high (D4)
 *   PD5  step, PD6 direction, PD7 enable (low)              (D5 to D7; spring build)
 *   PB1  carriage at its front end, switch to ground        (D9; spring build)
 *   PB2  enabling switch to ground, pull-up                 (D10; set-up mode)
 *
 *
 * With TAPPER_CHANNELS above 1 (solenoid build) D4 enables a 74HC238 decoder whose address is D5 to
 * D7, so two coils can never be on together, whatever the program does. The switches at the mounts,
 * closed to ground while the striker is back, are A0 to A5 (channels 0 to 5), D9 (6) and D11 (7),
 * with pull-ups.
 *
 * TAPPER_DRIVE_SPRING: a stepper tensions a spring against a latch, which a pulse releases.
 * TAPPER_DRIVE_SOLENOID: a coil drives the striker; the width of its pulse sets the energy.
 */
#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/wdt.h>
#include <util/atomic.h>

#include "strikers.h"
#include "tapper.h"

#ifndef TAPPER_CHANNELS
#define TAPPER_CHANNELS 1
#endif
#if TAPPER_CHANNELS < 1 || TAPPER_CHANNELS > 8
#error "TAPPER_CHANNELS must be 1 to 8"
#endif
#if TAPPER_CHANNELS > 1 && defined(TAPPER_DRIVE_SPRING)
#error "several channels need the solenoid build"
#endif
#if defined(TAPPER_DRIVE_SPRING) == defined(TAPPER_DRIVE_SOLENOID)
#error "define TAPPER_DRIVE_SPRING or TAPPER_DRIVE_SOLENOID, one of them"
#endif

#define INTERLOCK PD2
#define STOP_LOOP PD3
#define RELEASE PD4
#define STEP PD5
#define DIRECTION PD6
#define DISABLE PD7
#define CLEAR_BUTTON PB0
#define FRONT PB1
#define ENABLING PB2

#define RECEIVE_SIZE 128u /* a power of two */
#define USED_SLOTS 32u
#define USED_PLACE 16u

static struct tapper tapper;
static volatile uint32_t milliseconds;
static volatile uint8_t received[RECEIVE_SIZE];
static volatile uint8_t head, tail;
static volatile bool stop_seen, wire_seen;
static volatile bool pulse_on;
static uint8_t next_slot;

struct used_slot {
    uint64_t shot;
    uint16_t check;
};

/* Switch the release output off; also called in interrupts. */
static inline void let_go(void)
{
    PORTD &= (uint8_t)~_BV(RELEASE);
    pulse_on = false;
}

static inline void halt_drive(void);
static inline void watch_strikers(void);

ISR(USART_RX_vect)
{
    uint8_t byte = UDR0;
    if (byte == '!') {
        stop_seen = true;
        let_go();
        return;
    }
    uint8_t following = (uint8_t)((head + 1u) & (RECEIVE_SIZE - 1u));
    if (following != tail) {
        received[head] = byte;
        head = following;
    }
}

ISR(TIMER0_COMPA_vect)
{
    milliseconds++;
    watch_strikers();
    if (PIND & _BV(STOP_LOOP)) {
        stop_seen = wire_seen = true;
        let_go();
        halt_drive();
    }
    if (PIND & _BV(INTERLOCK))
        let_go();
}

/* End the release pulse, independently of the main loop. */
ISR(TIMER1_COMPA_vect)
{
    let_go();
    TCCR1B = 0;
}

static enum tapper_release pulse(uint16_t microseconds, uint32_t deadline)
{
    enum tapper_release outcome = RELEASE_STOPPED;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        if (!tapper_in_window(deadline, milliseconds)) {
            outcome = RELEASE_LATE;
        } else if (!stop_seen && !(PIND & (_BV(STOP_LOOP) | _BV(INTERLOCK)))) {
            TCCR1A = 0;
            TCCR1B = 0;
            TCNT1 = 0;
            OCR1A = (uint16_t)(2u * microseconds); /* prescaler 8: 0.5 us per count, up to 32 ms */
            TIFR1 = _BV(OCF1A);
            TIMSK1 = _BV(OCIE1A);
            pulse_on = true;
            PORTD |= _BV(RELEASE);
            TCCR1B = _BV(CS11);
            outcome = RELEASE_BEGUN;
        }
    }
    return outcome;
}

bool board_enabled(void)
{
    return !(PINB & _BV(ENABLING));
}

bool board_interlock_closed(void)
{
    return !(PIND & _BV(INTERLOCK));
}

#ifdef TAPPER_DRIVE_SPRING

/* Constants of the mechanism; measure them and set them with -D at the build. */
#ifndef SPRING_N_PER_M
#define SPRING_N_PER_M 500ul
#endif
#ifndef NM_PER_STEP
#define NM_PER_STEP 5000ul /* lead 8 mm, 200 full steps, 8 microsteps each */
#endif
#define LATCH_PULSE_US 20000u

static struct drive drive; /* shared with the interrupts, so accessed only in atomic blocks */

static inline void watch_strikers(void)
{
}

static inline void halt_drive(void)
{
    drive_halt(&drive);
    PORTD |= _BV(DISABLE);
}

/* 8 kHz. */
ISR(TIMER2_COMPA_vect)
{
    uint8_t outputs = drive_tick(&drive, !(PINB & _BV(FRONT)));
    if (!(outputs & DRIVE_ENABLE))
        PORTD |= _BV(DISABLE);
    else
        PORTD &= (uint8_t)~_BV(DISABLE);
    if (!(outputs & DRIVE_STEP)) {
        PORTD &= (uint8_t)~_BV(STEP);
        return;
    }
    if (outputs & DRIVE_OUTWARD)
        PORTD |= _BV(DIRECTION);
    else
        PORTD &= (uint8_t)~_BV(DIRECTION);
    PORTD |= _BV(STEP);
}

static uint32_t root(uint64_t value)
{
    uint64_t result = 0;
    for (uint64_t bit = 1ull << 62; bit; bit >>= 2) {
        if (value >= result + bit) {
            value -= result + bit;
            result = (result >> 1) + bit;
        } else {
            result >>= 1;
        }
    }
    return (uint32_t)result;
}

/* E = k x^2 / 2, so x in um is sqrt(2e6 E in uJ / k). */
static uint32_t steps_for(uint32_t energy_uj)
{
    uint32_t nanometres = root(2000000ull * energy_uj / SPRING_N_PER_M * 1000000ull);
    return (nanometres + NM_PER_STEP / 2) / NM_PER_STEP;
}

/* Return whether a whole number of steps stores the requested energy within 3 %. */
bool board_can_store(uint32_t energy_uj)
{
    uint32_t steps = steps_for(energy_uj);
    if (steps == 0 || steps > LONGEST_DRAW_STEPS)
        return false;
    uint64_t nanometres = (uint64_t)steps * NM_PER_STEP;
    uint64_t stored = nanometres * nanometres / 1000000u * SPRING_N_PER_M / 2000000u;
    uint64_t error = stored > energy_uj ? stored - energy_uj : energy_uj - stored;
    return 100u * error <= 3ull * energy_uj;
}

void board_home(void)
{
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        drive_home(&drive);
    }
}

uint8_t board_at_mounts(void)
{
    return 0;
}

void board_charge(uint32_t energy_uj, uint8_t channel)
{
    (void)channel;
    int16_t steps = (int16_t)steps_for(energy_uj);
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        drive_out(&drive, steps);
    }
}

void board_discharge(void)
{
    let_go();
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        drive_back(&drive);
    }
}

void board_halt(void)
{
    let_go();
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        halt_drive();
    }
}

enum drive_status board_drive(void)
{
    enum drive_status status = DRIVE_UNKNOWN;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        status = drive_status(&drive);
    }
    return status;
}

enum tapper_release board_release(uint32_t deadline)
{
    return pulse(LATCH_PULSE_US, deadline);
}

static void start_drive(void)
{
    TCCR2A = _BV(WGM21);
    TCCR2B = _BV(CS21) | _BV(CS20); /* 16 MHz / 32 */
    OCR2A = 61;                     /* 8 kHz */
    TIMSK2 = _BV(OCIE2A);
    drive_start(&drive);
}

#else

/* Measured pairs of energy (uJ) and pulse width (us), both increasing. */
#ifndef SOLENOID_TABLE
#define SOLENOID_TABLE {100, 1500}, {5000, 4000}, {50000, 9000}, {200000, 20000}
#endif
static const uint32_t TABLE[][2] = {SOLENOID_TABLE};
#define ROWS (sizeof TABLE / sizeof TABLE[0])

static uint32_t charged_uj;

#if TAPPER_CHANNELS > 1
static struct strikers strikers; /* shared with the interrupt, so accessed only in atomic blocks */
static uint8_t charged_channel;

/* Called by the interrupt at 1 kHz. */
static inline void watch_strikers(void)
{
    uint8_t open = (uint8_t)((PINC & 0x3Fu) | ((PINB & _BV(PB1)) ? 0x40u : 0u) |
                             ((PINB & _BV(PB3)) ? 0x80u : 0u));
    strikers_tick(&strikers, (uint8_t)~open);
}

uint8_t board_at_mounts(void)
{
    uint8_t home = 0;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        home = strikers.home & strikers.fitted;
    }
    return home;
}

void board_home(void)
{
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        strikers_prove(&strikers);
    }
}

void board_charge(uint32_t energy_uj, uint8_t channel)
{
    charged_uj = energy_uj;
    charged_channel = channel;
}

enum drive_status board_drive(void)
{
    enum drive_status status = DRIVE_UNKNOWN;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        status = strikers_status(&strikers);
    }
    return status;
}

static void start_drive(void)
{
    PORTC = 0x3F;
    PORTB |= _BV(PB3);
    strikers_start(&strikers, TAPPER_CHANNELS);
}
#else
static inline void watch_strikers(void)
{
}

uint8_t board_at_mounts(void)
{
    return 0;
}

void board_home(void)
{
}

void board_charge(uint32_t energy_uj, uint8_t channel)
{
    (void)channel;
    charged_uj = energy_uj;
}

enum drive_status board_drive(void)
{
    return DRIVE_THERE;
}

static void start_drive(void)
{
}
#endif

static uint16_t width_for(uint32_t energy_uj)
{
    for (uint8_t row = 1; row < ROWS; row++)
        if (energy_uj <= TABLE[row][0])
            return (uint16_t)(TABLE[row - 1][1] +
                              (uint64_t)(energy_uj - TABLE[row - 1][0]) *
                                  (TABLE[row][1] - TABLE[row - 1][1]) /
                                  (TABLE[row][0] - TABLE[row - 1][0]));
    return 0;
}

bool board_can_store(uint32_t energy_uj)
{
    return energy_uj >= TABLE[0][0] && energy_uj <= TABLE[ROWS - 1][0];
}

void board_discharge(void)
{
    let_go();
}

void board_halt(void)
{
    let_go();
}

enum tapper_release board_release(uint32_t deadline)
{
#if TAPPER_CHANNELS > 1
    /* The release output is off, so the decoder's address may be changed. */
    PORTD = (uint8_t)((PORTD & ~(7u << STEP)) | (uint8_t)(charged_channel << STEP));
    enum tapper_release outcome = pulse(width_for(charged_uj), deadline);
    if (outcome == RELEASE_BEGUN)
        ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
        {
            strikers_released(&strikers, charged_channel);
        }
    return outcome;
#else
    return pulse(width_for(charged_uj), deadline);
#endif
}

static inline void halt_drive(void)
{
}

#endif

uint8_t board_channels(void)
{
    return TAPPER_CHANNELS;
}

bool board_releasing(void)
{
    return pulse_on;
}

static uint16_t slot_check(const struct used_slot *slot)
{
    return tapper_crc((const char *)&slot->shot, sizeof slot->shot);
}

static uint8_t *slot_place(uint8_t index)
{
    return (uint8_t *)(uintptr_t)(USED_PLACE + index * sizeof(struct used_slot));
}

/* Return the greatest stored shot. The slots are written in turn, so the EEPROM lasts 3 million
 * shots. */
static uint64_t read_used(void)
{
    uint64_t greatest = 0;
    for (uint8_t index = 0; index < USED_SLOTS; index++) {
        struct used_slot slot;
        eeprom_read_block(&slot, slot_place(index), sizeof slot);
        if (slot.check == slot_check(&slot) && slot.shot >= greatest) {
            greatest = slot.shot;
            next_slot = (uint8_t)((index + 1u) % USED_SLOTS);
        }
    }
    return greatest;
}

void board_keep_used(uint64_t shot)
{
    struct used_slot slot = {.shot = shot};
    slot.check = slot_check(&slot);
    eeprom_update_block(&slot, slot_place(next_slot), sizeof slot);
    next_slot = (uint8_t)((next_slot + 1u) % USED_SLOTS);
}

static uint32_t count_boot(void)
{
    uint32_t boot = eeprom_read_dword((uint32_t *)0);
    boot = boot == 0xFFFFFFFFul ? 1 : boot + 1;
    eeprom_update_dword((uint32_t *)0, boot);
    return boot;
}

uint32_t board_forget_used(void)
{
    static const struct used_slot EMPTY = {0, 0};
    for (uint8_t index = 0; index < USED_SLOTS; index++) {
        wdt_reset(); /* writing a slot takes 34 ms */
        eeprom_update_block(&EMPTY, slot_place(index), sizeof EMPTY);
    }
    return count_boot();
}

void board_send(const char *text)
{
    while (*text) {
        while (!(UCSR0A & _BV(UDRE0)))
            wdt_reset(); /* a byte is sent every 87 us, so the loop ends */
        UDR0 = (uint8_t)*text++;
    }
}

static uint32_t now_ms(void)
{
    uint32_t now;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        now = milliseconds;
    }
    return now;
}

/* Execute a stop detected by an interrupt; an open stop loop repeats it every millisecond. */
static void take_stop(void)
{
    bool seen, by_wire;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        seen = stop_seen;
        by_wire = wire_seen;
        stop_seen = wire_seen = false;
    }
    if (seen)
        tapper_stop(&tapper, by_wire);
}

int main(void)
{
    MCUSR = 0;
    wdt_enable(WDTO_250MS);
    DDRD = _BV(RELEASE) | _BV(STEP) | _BV(DIRECTION) | _BV(DISABLE);
    PORTD = _BV(INTERLOCK) | _BV(STOP_LOOP) | _BV(DISABLE);
    PORTB = _BV(CLEAR_BUTTON) | _BV(FRONT) | _BV(ENABLING);
    TCCR0A = _BV(WGM01);
    TCCR0B = _BV(CS01) | _BV(CS00); /* 16 MHz / 64 */
    OCR0A = 249;                    /* 1 kHz */
    TIMSK0 = _BV(OCIE0A);
    UCSR0A = _BV(U2X0);
    UBRR0 = 16; /* 117647 baud, 2.1 % above 115200, as on every 16 MHz board */
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
    start_drive();
    tapper_start(&tapper, count_boot(), read_used(), 0);
    sei();

    for (;;) {
        wdt_reset();
        uint32_t now = now_ms();
        take_stop();
        tapper_button(&tapper, !(PINB & _BV(CLEAR_BUTTON)), now);
        tapper_poll(&tapper, now);
        while (tail != head) {
            uint8_t byte = received[tail];
            tail = (uint8_t)((tail + 1u) & (RECEIVE_SIZE - 1u));
            take_stop();
            tapper_byte(&tapper, byte, now_ms());
        }
    }
}
